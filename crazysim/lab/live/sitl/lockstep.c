/* Clock and packets of Betaflight's simulator target in lock-step, loaded before its libraries (LD_PRELOAD).
 *
 * The main thread's time is simulated: each look at the clock takes READ_TIME, a pause takes its length, and work takes
 * none. After START_TIME, in which the program starts, it stops at the time stamp of the newest state packet, answers
 * with its newest motor packet, and waits for the next state packet. So a flight depends on the packets alone.
 *
 * A remote-control packet follows its state packet in the same datagram, because two datagrams may change their order.
 * CRAZYSIM_PORTS holds the ports of motor, state and remote-control packets, which replace those in the program.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

enum { MOTORS, STATE, RC, N_PORTS };
static const int program_ports[N_PORTS] = {9002, 9003, 9004};
static int ports[N_PORTS], sockets[N_PORTS] = {-1, -1, -1};

#define SECOND INT64_C(1000000000) /* times are in ns */
#define READ_TIME 1000             /* the resolution of the program's clock */
#define START_TIME (2 * SECOND)    /* longer than the program's start */

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t change = PTHREAD_COND_INITIALIZER;
static int64_t now, limit = START_TIME - 1, packet_time;
static int n_rc_packets; /* that the program has read */
static bool has_state, has_rc;
static float motors[4];
static pid_t parent;
static _Thread_local enum { OTHER, MAIN, RECEIVER } thread;

static int (*real_bind)(int, const struct sockaddr *, socklen_t);
static int (*real_select)(int, fd_set *, fd_set *, fd_set *, struct timeval *);
static int (*real_clock_gettime)(clockid_t, struct timespec *);
static int (*real_nanosleep)(const struct timespec *, struct timespec *);
static ssize_t (*real_recvfrom)(int, void *, size_t, int, struct sockaddr *, socklen_t *);
static ssize_t (*real_sendto)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);

__attribute__((constructor)) static void start(void)
{
    thread = MAIN;
    parent = getppid();
    setvbuf(stdout, NULL, _IOLBF, 0);
    *(void **)&real_bind = dlsym(RTLD_NEXT, "bind");
    *(void **)&real_select = dlsym(RTLD_NEXT, "select");
    *(void **)&real_clock_gettime = dlsym(RTLD_NEXT, "clock_gettime");
    *(void **)&real_nanosleep = dlsym(RTLD_NEXT, "nanosleep");
    *(void **)&real_recvfrom = dlsym(RTLD_NEXT, "recvfrom");
    *(void **)&real_sendto = dlsym(RTLD_NEXT, "sendto");
    const char *text = getenv("CRAZYSIM_PORTS");
    if (text == NULL || sscanf(text, "%d,%d,%d", &ports[MOTORS], &ports[STATE], &ports[RC]) != N_PORTS) {
        memcpy(ports, program_ports, sizeof(ports));
    }
}

static void send_to_port(int port, const void *data, size_t size)
{
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    real_sendto(sockets[STATE], data, size, 0, (struct sockaddr *)&to, sizeof(to));
}

/* Pass time in the main thread, which stops at the limit. */
static int64_t advance(int64_t time)
{
    pthread_mutex_lock(&lock);
    while (now + time > limit) {
        const int64_t last = limit;
        time -= limit - now;
        now = limit;
        send_to_port(ports[MOTORS], motors, sizeof(motors));
        while (limit == last) {
            struct timespec second_later;
            real_clock_gettime(CLOCK_REALTIME, &second_later);
            ++second_later.tv_sec;
            pthread_cond_timedwait(&change, &lock, &second_later);
            if (getppid() != parent) _exit(1); /* the simulation has ended */
        }
    }
    time = now += time;
    pthread_mutex_unlock(&lock);
    return time;
}

int clock_gettime(clockid_t id, struct timespec *out)
{
    if (id != CLOCK_MONOTONIC || thread == OTHER) return real_clock_gettime(id, out);
    const int64_t time = thread == MAIN ? advance(READ_TIME) : now; /* a receiver works while the main thread waits */
    out->tv_sec = time / SECOND;
    out->tv_nsec = time % SECOND;
    return 0;
}

int nanosleep(const struct timespec *time, struct timespec *rest)
{
    if (thread != MAIN) return real_nanosleep(time, rest);
    advance(time->tv_sec * SECOND + time->tv_nsec);
    return 0;
}

int bind(int fd, const struct sockaddr *address, socklen_t size)
{
    struct sockaddr_in other;
    if (address->sa_family != AF_INET || size < sizeof(other)) return real_bind(fd, address, size);
    memcpy(&other, address, sizeof(other));
    for (int i = STATE; i <= RC; ++i) {
        if (ntohs(other.sin_port) == program_ports[i]) {
            sockets[i] = fd;
            other.sin_port = htons((uint16_t)ports[i]);
            return real_bind(fd, (struct sockaddr *)&other, sizeof(other));
        }
    }
    return real_bind(fd, address, size);
}

/* A thread that waits for its next packet has done its work with the last one. */
int select(int n, fd_set *read, fd_set *write, fd_set *except, struct timeval *timeout)
{
    pthread_mutex_lock(&lock);
    if (has_state && read != NULL && FD_ISSET(sockets[STATE], read)) {
        has_state = false;
        limit = packet_time;
    }
    if (has_rc && read != NULL && FD_ISSET(sockets[RC], read)) {
        has_rc = false;
        ++n_rc_packets;
    }
    pthread_cond_broadcast(&change);
    pthread_mutex_unlock(&lock);
    return real_select(n, read, write, except, timeout);
}

ssize_t recvfrom(int fd, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *from_size)
{
    if (fd != sockets[STATE]) {
        const ssize_t n = real_recvfrom(fd, data, size, flags, from, from_size);
        if (fd == sockets[RC]) has_rc = n > 0;
        return n;
    }
    char packet[256];
    const ssize_t n = real_recvfrom(fd, packet, sizeof(packet), flags, from, from_size);
    if (n < (ssize_t)size) return -1;
    memcpy(data, packet, size);
    double seconds;
    memcpy(&seconds, packet, sizeof(seconds));
    const int64_t time = START_TIME + (int64_t)(seconds * SECOND + 0.5);
    thread = RECEIVER;
    pthread_mutex_lock(&lock);
    has_state = time > limit;
    packet_time = time;
    if (n > (ssize_t)size) {
        const int last = n_rc_packets;
        send_to_port(ports[RC], packet + size, (size_t)n - size);
        while (n_rc_packets == last) pthread_cond_wait(&change, &lock);
    }
    pthread_mutex_unlock(&lock);
    return (ssize_t)size;
}

ssize_t sendto(int fd, const void *data, size_t size, int flags, const struct sockaddr *to, socklen_t to_size)
{
    struct sockaddr_in address;
    if (to == NULL || to_size < sizeof(address)) return real_sendto(fd, data, size, flags, to, to_size);
    memcpy(&address, to, sizeof(address));
    if (size != sizeof(motors) || ntohs(address.sin_port) != program_ports[MOTORS]) {
        return real_sendto(fd, data, size, flags, to, to_size);
    }
    memcpy(motors, data, size);
    return (ssize_t)size;
}
