/* Counts the calls of a process and its children that change a folder, and kills the process before one of them.

kills.py preloads this library, which does nothing unless the environment has KILLS_FOLDER. Then KILLS_COUNT is the file
of a counter that all processes share, and the process is killed before call number KILLS_AT. The file KILLS_LOG gets a
line for each call that succeeded. The folder KILLS_KEEP gets a link to each file that is replaced or removed. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static long *count;
static int log_file;

// Write the absolute path to `out`; return 1 if it is KILLS_FOLDER or below it.
static int absolute(int folder, const char *path, char *out) {
    char link[64], base[PATH_MAX] = "";
    const char *root = getenv("KILLS_FOLDER");
    if (!root || !path) return 0;
    if (!count) {
        int file = REAL(openat)(AT_FDCWD, getenv("KILLS_COUNT"), O_RDWR | O_CLOEXEC);
        log_file = REAL(openat)(AT_FDCWD, getenv("KILLS_LOG"), O_WRONLY | O_APPEND | O_CLOEXEC);
        count = mmap(0, sizeof *count, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    }
    if (*path != '/') {
        snprintf(link, sizeof link, folder == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", folder);
        if (readlink(link, base, sizeof base - 1) < 0) return 0;
        strcat(base, "/");
    }
    snprintf(out, PATH_MAX, "%s%s", base, path);
    return !strncmp(out, root, strlen(root)) && (out[strlen(root)] == '/' || !out[strlen(root)]);
}

// Write the path of an open file to `out`; return 1 if it is KILLS_FOLDER or below it.
static int opened(int file, char *out) {
    char link[64], path[PATH_MAX] = "";
    if (!getenv("KILLS_FOLDER")) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    return readlink(link, path, sizeof path - 1) > 0 && *path == '/' && absolute(AT_FDCWD, path, out);
}

// Count a call; kill the process if it is call number KILLS_AT.
static void before(const char *kind) {
    long number = __atomic_add_fetch(count, 1, __ATOMIC_SEQ_CST);
    if (number != atol(getenv("KILLS_AT"))) return;
    dprintf(log_file, "end\t0\t0\t%s\t\n", kind);
    kill(getpid(), SIGKILL);
}

// Return the inode of a path; 0 if there is none.
static ino_t number_of(const char *path) {
    struct stat status;
    return lstat(path, &status) ? 0 : status.st_ino;
}

// Link a file that will be replaced or removed into KILLS_KEEP, under its inode.
static void keep(const char *path) {
    char copy[PATH_MAX];
    struct stat status;
    if (lstat(path, &status) || !S_ISREG(status.st_mode)) return;
    snprintf(copy, sizeof copy, "%s/%lu", getenv("KILLS_KEEP"), (unsigned long)status.st_ino);
    link(path, copy);
}

// Write a line for a call that succeeded: its kind, inode, size, path, and new path.
static void note(const char *kind, ino_t number, long size, const char *path, const char *target) {
    int error = errno;
    dprintf(log_file, "%s\t%lu\t%ld\t%s\t%s\n", kind, (unsigned long)number, size, path, target);
    errno = error;
}

static int open_any(__typeof__(&openat) real, int folder, const char *path, int flags, mode_t mode) {
    char name[PATH_MAX];
    if (!(flags & (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC)) || !absolute(folder, path, name))
        return real(folder, path, flags, mode);
    before("open");
    int is_new = !number_of(name), file = real(folder, path, flags, mode);
    if (file >= 0 && (is_new || flags & O_TRUNC)) note(is_new ? "create" : "truncate", number_of(name), 0, name, "");
    return file;
}

#define MODE(flags, list, mode)                                         \
    va_list list;                                                       \
    va_start(list, flags);                                              \
    mode_t mode = (flags) & (O_CREAT | O_TMPFILE) ? va_arg(list, mode_t) : 0; \
    va_end(list)

int openat(int folder, const char *path, int flags, ...) {
    MODE(flags, list, mode);
    return open_any(REAL(openat), folder, path, flags, mode);
}
int open(const char *path, int flags, ...) {
    MODE(flags, list, mode);
    return open_any(REAL(openat), AT_FDCWD, path, flags, mode);
}
int openat64(int folder, const char *path, int flags, ...) __attribute__((alias("openat")));
int open64(const char *path, int flags, ...) __attribute__((alias("open")));

#define FOPEN(name)                                                       \
    FILE *name(const char *path, const char *mode) {                      \
        char full[PATH_MAX];                                              \
        int counted = *mode != 'r' && absolute(AT_FDCWD, path, full);     \
        if (counted) before("open");                                      \
        ino_t number = counted ? number_of(full) : 0;                     \
        FILE *file = REAL(name)(path, mode);                              \
        if (counted && file) note(number ? "truncate" : "create", number_of(full), 0, full, ""); \
        return file;                                                      \
    }
FOPEN(fopen)
FOPEN(fopen64)

#define ON_FILE(type, name, kind, file, arguments, ...)                            \
    type name(__VA_ARGS__) {                                                       \
        char path[PATH_MAX];                                                       \
        struct stat status;                                                        \
        int counted = opened(file, path);                                          \
        if (counted) before(kind);                                                 \
        type result = REAL(name) arguments;                                        \
        if (counted && !fstat(file, &status)) note(kind, status.st_ino, status.st_size, path, ""); \
        return result;                                                             \
    }
ON_FILE(ssize_t, write, "write", file, (file, data, size), int file, const void *data, size_t size)
ON_FILE(ssize_t, pwrite64, "write", file, (file, data, size, at), int file, const void *data, size_t size, off64_t at)
ON_FILE(int, ftruncate64, "write", file, (file, size), int file, off64_t size)
ON_FILE(size_t, fwrite, "write", fileno(file), (data, size, many, file), const void *data, size_t size, size_t many, FILE *file)
ON_FILE(int, fsync, "fsync", file, (file), int file)
ON_FILE(int, fdatasync, "fsync", file, (file), int file)

#define ON_PATH(name, kind, folder, arguments, ...)                      \
    int name(__VA_ARGS__) {                                              \
        char full[PATH_MAX];                                             \
        int counted = absolute(folder, path, full);                      \
        if (counted) before(kind), keep(full);                           \
        int result = REAL(name) arguments;                               \
        if (counted && !result) note(kind, number_of(full), 0, full, ""); \
        return result;                                                   \
    }
ON_PATH(unlink, "unlink", AT_FDCWD, (path), const char *path)
ON_PATH(unlinkat, "unlink", folder, (folder, path, flags), int folder, const char *path, int flags)
ON_PATH(rmdir, "unlink", AT_FDCWD, (path), const char *path)
ON_PATH(mkdir, "create", AT_FDCWD, (path, mode), const char *path, mode_t mode)

int rename(const char *path, const char *target) {
    char from[PATH_MAX], to[PATH_MAX];
    int counted = absolute(AT_FDCWD, path, from) && absolute(AT_FDCWD, target, to);
    if (counted) before("rename"), keep(to);
    int result = REAL(rename)(path, target);
    if (counted && !result) note("rename", number_of(to), 0, from, to);
    return result;
}
