# gsmerge on a CPU, with the rights of whoever runs it, so that it writes beside the scene:
# docker build -t gsmerge . && docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/data" gsmerge compact scene.ply
# The base by its digest, for images that can be made again: --build-arg BASE=python@sha256:...
ARG BASE=python:3.11-slim-bookworm
FROM $BASE

WORKDIR /opt/gsmerge
COPY pyproject.toml setup.py constraints.txt README.md LICENSE ./
COPY gsmerge gsmerge
# What the build itself installs is pinned by the environment: by the first name up to pip 25.2, then by the second
ENV PIP_CONSTRAINT=/opt/gsmerge/constraints.txt PIP_BUILD_CONSTRAINT=/opt/gsmerge/constraints.txt
RUN pip install --no-cache-dir -c constraints.txt .

WORKDIR /data
ENV HOME=/tmp
USER 1000
ENTRYPOINT ["gsmerge"]
CMD ["--help"]
