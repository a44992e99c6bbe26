/* Calls of the file system that fail: a library for LD_PRELOAD, which tests.faults.worker arms.

   It counts the calls of this process that change files whose paths begin with a prefix. The call of a chosen number
   fails with an error of the system, or ends the process by SIGKILL if that error is 0. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static char prefix[4096];
static char mark[4096];
static long count;
static long target;
static int failure;

/* Let the call of this number from now on (from 1; 0 for none) fail with an error number; a file gets the time. */
void fail_at(long number, int error, const char *paths, const char *when)
{
    snprintf(prefix, sizeof prefix, "%s", paths);
    snprintf(mark, sizeof mark, "%s", when);
    count = 0;
    failure = error;
    target = number;
}

long calls_counted(void)
{
    return count;
}

/* Count a call on a path; return whether it fails. */
static int fails(const char *path)
{
    char text[64];
    if (!prefix[0] || !path || strncmp(path, prefix, strlen(prefix)))
        return 0;
    if (++count != target)
        return 0;

    /* By system calls, which are not counted. */
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    int length = snprintf(text, sizeof text, "%ld.%06ld", (long)now.tv_sec, now.tv_nsec / 1000);
    int file = syscall(SYS_openat, AT_FDCWD, mark, O_WRONLY | O_CREAT | O_TRUNC, 0644);
    syscall(SYS_write, file, text, length);
    syscall(SYS_close, file);
    if (!failure)
        raise(SIGKILL);
    errno = failure;
    return 1;
}

static int fails_of(int descriptor)
{
    char link[64], path[4096];
    int saved = errno;
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t length = readlink(link, path, sizeof path - 1);
    errno = saved;
    if (length < 0)
        return 0;
    path[length] = 0;
    return fails(path);
}

/* A call with the name, the arguments and the first argument, a path or a descriptor, of one of the system. */
#define CALL(result, name, check, parameters, arguments)                                                               \
    result name parameters                                                                                             \
    {                                                                                                                  \
        static result(*original) parameters;                                                                           \
        if (!original)                                                                                                 \
            original = (result(*) parameters)dlsym(RTLD_NEXT, #name);                                                  \
        if (check)                                                                                                     \
            return -1;                                                                                                 \
        return original arguments;                                                                                     \
    }

CALL(ssize_t, write, fails_of(file), (int file, const void *data, size_t size), (file, data, size))
CALL(ssize_t, pwrite, fails_of(file), (int file, const void *data, size_t size, off_t at), (file, data, size, at))
CALL(ssize_t, pwrite64, fails_of(file), (int file, const void *data, size_t size, off64_t at), (file, data, size, at))
CALL(int, ftruncate, fails_of(file), (int file, off_t length), (file, length))
CALL(int, ftruncate64, fails_of(file), (int file, off64_t length), (file, length))
CALL(int, fsync, fails_of(file), (int file), (file))
CALL(int, rename, fails(path) || fails(target_path), (const char *path, const char *target_path), (path, target_path))
CALL(int, unlink, fails(path), (const char *path), (path))
CALL(int, rmdir, fails(path), (const char *path), (path))
CALL(int, mkdir, fails(path), (const char *path, mode_t mode), (path, mode))

/* Opening takes a mode only where it creates a file. */
#define OPEN(name)                                                                                                     \
    int name(const char *path, int flags, ...)                                                                         \
    {                                                                                                                  \
        static int (*original)(const char *, int, ...);                                                                \
        va_list more;                                                                                                  \
        va_start(more, flags);                                                                                         \
        mode_t mode = va_arg(more, mode_t);                                                                            \
        va_end(more);                                                                                                  \
        if (!original)                                                                                                 \
            original = (int (*)(const char *, int, ...))dlsym(RTLD_NEXT, #name);                                       \
        if (fails(path))                                                                                               \
            return -1;                                                                                                 \
        return original(path, flags, mode);                                                                            \
    }

OPEN(open)
OPEN(open64)
