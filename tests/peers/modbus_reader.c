/* A Modbus client on libmodbus: reads the same registers again and again, as fast as it can.
 *
 * usage: modbus_reader HOST PORT FUNCTION ADDRESS COUNT READS [PAUSE_US]     over TCP, or
 *        modbus_reader DEVICE UNIT FUNCTION ADDRESS COUNT READS [PAUSE_US]   over a serial line, 9600 baud: has a /
 * stdout: READS * COUNT registers, 16 bit, in the machine's byte order
 * stderr: seconds taken, then median, 99th percentile and longest read in us; or what went wrong (exit status 1)
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + now.tv_nsec * 1e-9;
}

static int longer(const void *a, const void *b) {
    double left = *(const double *)a, right = *(const double *)b;
    return (left > right) - (left < right);
}

static int fail(const char *what) {
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    return 1;
}

int main(int argc, char **argv) {
    if (argc != 7 && argc != 8) {
        fprintf(stderr, "usage: %s HOST PORT FUNCTION ADDRESS COUNT READS [PAUSE_US]\n", argv[0]);
        return 2;
    }
    int function = atoi(argv[3]), address = atoi(argv[4]), count = atoi(argv[5]);
    long reads = atol(argv[6]), pause_us = argc == 8 ? atol(argv[7]) : 0;
    int serial = strchr(argv[1], '/') != NULL;
    modbus_t *client = serial ? modbus_new_rtu(argv[1], 9600, 'N', 8, 1) : modbus_new_tcp_pi(argv[1], argv[2]);
    if (serial) modbus_set_slave(client, atoi(argv[2]));
    modbus_set_response_timeout(client, 10, 0);
    if (modbus_connect(client) != 0) return fail("connect");

    uint16_t *words = malloc(sizeof *words * count * reads);
    double *took = malloc(sizeof *took * reads);
    double start = seconds(), before = start;
    for (long i = 0; i < reads; i++) {
        uint16_t *row = words + i * count;
        int got = function == 3 ? modbus_read_registers(client, address, count, row)
                                : modbus_read_input_registers(client, address, count, row);
        if (got != count) return fail("read");
        double now = seconds();
        took[i] = now - before;
        if (pause_us) nanosleep(&(struct timespec){pause_us / 1000000, pause_us % 1000000 * 1000}, NULL);
        before = pause_us ? seconds() : now;
    }
    double all = before - start;
    qsort(took, reads, sizeof *took, longer);
    fprintf(stderr, "%.4f %.1f %.1f %.1f\n", all, 1e6 * took[reads / 2], 1e6 * took[reads * 99 / 100],
            1e6 * took[reads - 1]);
    fwrite(words, sizeof *words, count * reads, stdout);
    modbus_close(client);
    modbus_free(client);
    free(words);
    free(took);
    return 0;
}
