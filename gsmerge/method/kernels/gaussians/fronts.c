// Find the pixels of Gaussians by projecting their centres, without drawing a picture.
#include "exp_log.h"

static const double REACH2 = 11.1;  // squared number of standard deviations at which a Gaussian ends: 2 ln 255
static const double DILATION = 0.3;  // dilation of Gaussians by the rasterizer, square pixels
static const float OPAQUE = 0.99f;  // largest opacity in the rasterizer

static inline double along(const double *row, const float *p) {
  return row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3];
}

// How far a coordinate lies outside the range from 0 to `count`; 0 inside.
static inline double beyond(double x, double count) {
  return x < 0.0 ? -x : x > count ? x - count : 0.0;
}

// See fronts.py. An area is negative if the centre is outside of the picture.
API int64_t project_centres(const float *restrict means, const float *restrict scales,
                            const double *restrict viewmat, const double *restrict K, int64_t width,
                            int64_t height, double near, int32_t *restrict ids,
                            int32_t *restrict pixels, float *restrict depths,
                            float *restrict areas, int64_t n) {
  double focal2 = absf8(K[0] * K[4]), w = (double)width, h = (double)height;
  int64_t m = 0;
  for (int64_t i = 0; i < n && w > 0 && h > 0; i++) {
    const float *s = scales + 3 * i;
    double z = along(viewmat + 8, means + 3 * i);
    if (!(z > near)) continue;
    double down = along(viewmat + 4, means + 3 * i), right = along(viewmat, means + 3 * i);
    double x = (K[0] * right + K[1] * down) / z + K[2], y = K[4] * down / z + K[5];
    double dx = beyond(x, w), dy = beyond(y, h), away = dx * dx + dy * dy;
    double longest = maxf(s[0], maxf(s[1], s[2])), pixel2 = focal2 / (z * z);
    double radius2 = longest * longest * pixel2 + DILATION;
    if (!(away <= REACH2 * radius2)) continue;
    double disc = maxd((double)s[0] * s[1], maxd((double)s[1] * s[2], (double)s[2] * s[0]));
    float share = away > 0.0 ? -exp4((float)(-0.5 * away / radius2)) : 1.f;
    int64_t column = (int64_t)mind(maxd(x, 0.0), w - 1), row = (int64_t)mind(maxd(y, 0.0), h - 1);
    ids[m] = (int32_t)i;
    pixels[m] = (int32_t)(row * width + column);
    depths[m] = (float)z;
    areas[m++] = share * (float)(disc * pixel2 + DILATION);
  }
  return m;
}

// Pass over Gaussians, nearest first, and keep the transmittance of each pixel.
API int32_t weigh_centres(const int32_t *restrict order, const int32_t *restrict ids,
                          const int32_t *restrict pixels, const float *restrict areas,
                          const float *restrict opacities, float *restrict passing,
                          float *restrict most, int32_t *restrict fronts, float *restrict weights,
                          int64_t some, int64_t m, int64_t n, int64_t h, int64_t w) {
  for (int64_t k = 0; k < some; k++) {
    int64_t j = order[k];
    if (j < 0 || j >= m) return OUTSIDE;
    int64_t i = ids[j], p = pixels[j];
    if (i < 0 || i >= n || p < 0 || p >= h * w) return OUTSIDE;
    float weight = opacities[i] * passing[p];
    weights[j] = weight * absf4(areas[j]);
    if (areas[j] < 0.f) continue;
    if (weight > most[p]) {
      most[p] = weight;
      fronts[p] = (int32_t)i;
    }
    passing[p] *= 1.f - minf(opacities[i], OPAQUE);
  }
  return 0;
}
