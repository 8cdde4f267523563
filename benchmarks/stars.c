/*
 * The bare star in C: one process that echoes datagrams, and processes of agents that time the way there and back.
 *
 *     star HZ TICKS PRIORITY DIRECTORY < packs
 *
 * packs: the number of processes, and per process the number of its packs with size and phase (s) of each. Every process writes
 * DIRECTORY/NUMBER.f64: per pack and tick the pack's size, its lateness and the round trip (-1: did not come), us. Printed are
 * the processor times of the echo and of all agents, s.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { PACKET_BYTES = 64, PACKS_MAX = 256, BUFFER_BYTES = 4 << 20, WARM_UP_MS = 500, LINGER_MS = 500 };

struct pack { int size; double phase_s; long k; };
struct packet { unsigned number; long k; double sent_s; };

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void take_fifo(int priority)
{
    struct sched_param parameter = {.sched_priority = priority};
    sched_setscheduler(0, SCHED_FIFO, &parameter); /* as agents do: where it is permitted */
}

static void echo(int server)
{
    char data[2048];
    struct sockaddr_in from;
    for (;;) {
        socklen_t length = sizeof from;
        ssize_t bytes = recvfrom(server, data, sizeof data, 0, (struct sockaddr *)&from, &length);
        if (bytes == 1)
            return; /* the end's mark */
        if (bytes > 0)
            sendto(server, data, bytes, 0, (struct sockaddr *)&from, length);
    }
}

static void take(int client, double *values, long ticks, int wait_flag)
{
    char data[2048];
    ssize_t bytes;
    while ((bytes = recv(client, data, sizeof data, wait_flag)) > 0) {
        struct packet packet;
        memcpy(&packet, data, sizeof packet);
        values[3 * (packet.number * ticks + packet.k) + 2] = 1e6 * (now_s() - packet.sent_s);
    }
}

static void agents(struct sockaddr_in *host, double t0_s, double hz, long ticks, struct pack *packs, int count, const char *path)
{
    int client = socket(AF_INET, SOCK_DGRAM, 0), left = count;
    connect(client, (struct sockaddr *)host, sizeof *host);
    double *values = calloc(3 * count * ticks, sizeof *values);
    for (long i = 0; i < count * ticks; i++)
        values[3 * i + 2] = -1;
    while (left) {
        int next = -1;
        double due_s = 0;
        for (int i = 0; i < count; i++) {
            double at_s = t0_s + packs[i].phase_s + packs[i].k / hz;
            if (packs[i].k < ticks && (next < 0 || at_s < due_s))
                next = i, due_s = at_s;
        }
        double wait_s = due_s - now_s();
        if (wait_s > 0) {
            struct timespec wait = {.tv_sec = (long)wait_s, .tv_nsec = (long)(1e9 * (wait_s - (long)wait_s))};
            struct pollfd readable = {.fd = client, .events = POLLIN};
            if (ppoll(&readable, 1, &wait, NULL) > 0)
                take(client, values, ticks, MSG_DONTWAIT);
            continue;
        }
        struct pack *pack = &packs[next];
        double begun_s = now_s(), first_s = t0_s + pack->phase_s;
        /* As in runs: a tick that could not begin within its period is missed, and the newest due one begins. */
        long newest = (long)((begun_s - first_s) * hz);
        if (newest > pack->k)
            pack->k = newest;
        if (pack->k >= ticks) {
            left--;
            continue;
        }
        double *value = &values[3 * (next * ticks + pack->k)];
        value[0] = pack->size;
        value[1] = 1e6 * (begun_s - first_s - pack->k / hz);
        char data[PACKET_BYTES * 8] = {0};
        struct packet packet = {next, pack->k, begun_s};
        memcpy(data, &packet, sizeof packet);
        send(client, data, PACKET_BYTES * pack->size, 0);
        if (++pack->k >= ticks)
            left--;
    }
    struct timeval linger = {.tv_usec = 1000 * LINGER_MS};
    setsockopt(client, SOL_SOCKET, SO_RCVTIMEO, &linger, sizeof linger);
    take(client, values, ticks, 0);
    FILE *file = fopen(path, "w");
    for (long i = 0; i < count * ticks; i++)
        if (values[3 * i] > 0)
            fwrite(&values[3 * i], sizeof *values, 3, file);
    fclose(file);
}

static double cpu_s(struct rusage *usage)
{
    return usage->ru_utime.tv_sec + usage->ru_stime.tv_sec + 1e-6 * (usage->ru_utime.tv_usec + usage->ru_stime.tv_usec);
}

int main(int argc, char **argv)
{
    if (argc != 5)
        return 2;
    double hz = atof(argv[1]), t0_s, host_s = 0, agents_s = 0;
    long ticks = atol(argv[2]);
    int priority = atoi(argv[3]), processes, buffer = BUFFER_BYTES, status;
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t length = sizeof address;
    int server = socket(AF_INET, SOCK_DGRAM, 0);
    setsockopt(server, SOL_SOCKET, SO_RCVBUF, &buffer, sizeof buffer);
    if (bind(server, (struct sockaddr *)&address, length) || getsockname(server, (struct sockaddr *)&address, &length))
        return 1;
    if (scanf("%d", &processes) != 1)
        return 2;
    pid_t host = fork();
    if (!host) {
        take_fifo(priority);
        echo(server);
        _exit(0);
    }
    t0_s = now_s() + 1e-3 * WARM_UP_MS;
    for (int process = 0; process < processes; process++) {
        static struct pack packs[PACKS_MAX];
        int count;
        if (scanf("%d", &count) != 1 || count > PACKS_MAX)
            return 2;
        for (int i = 0; i < count; i++) {
            if (scanf("%d %lf", &packs[i].size, &packs[i].phase_s) != 2)
                return 2;
            packs[i].k = 0;
        }
        if (!fork()) {
            char path[4096];
            snprintf(path, sizeof path, "%s/%04d.f64", argv[4], process);
            take_fifo(priority);
            agents(&address, t0_s, hz, ticks, packs, count, path);
            _exit(0);
        }
    }
    struct rusage usage;
    for (int left = processes; left; left--) {
        wait4(-1, &status, 0, &usage);
        agents_s += cpu_s(&usage);
    }
    int end = socket(AF_INET, SOCK_DGRAM, 0);
    sendto(end, "", 1, 0, (struct sockaddr *)&address, length);
    wait4(host, &status, 0, &usage);
    host_s = cpu_s(&usage);
    printf("%f %f\n", host_s, agents_s);
    return 0;
}
