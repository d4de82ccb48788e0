/* A PLC that tends the paint booth, on libmodbus: plc_loop PORT

   Polls the statistics area (125 registers at 2000), orders by `action` once for each sequence while VALID is set, the
   statistics are fresh and `confidence` is 0.5 or more, and 30 panels after an order resets the statistics by the
   command handshake. Written from deploy/plc/registers.md alone. Each order is a line of JSON on standard output. */
#include <errno.h>
#include <modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

enum { STATISTICS = 2000, WORDS = 125, CONTROL = 500, COMMAND = 504, HANDSHAKE = 19 };
enum { VALID = 1, EXECUTE = 1 << 7, ENDED = 3 << 10, RESET_STATISTICS = 2, SETTLE = 30, POLL_US = 20000 };

static void order(int after, const char *deed) {
    printf("{\"after\": %d, \"order\": \"%s\"}\n", after, deed);
    fflush(stdout);
}

static int act(int after, int action) {
    if (action == 1) order(after, "CHANGE_FILTER"), order(after, "CLEAN_BOOTH");
    else if (action == 2) order(after, "CHANGE_FILTER");
    else if (action == 3) order(after, "CLEAN_BOOTH");
    else if (action == 4) order(after, "CLEAN_FIXTURE");
    else return 0;
    return 1;
}

static int reset(modbus_t *station) {
    const uint16_t block[8] = {EXECUTE, 0, 0, 0, RESET_STATISTICS, 0, 0, 0}, none[8] = {0};
    uint16_t answers = 0;
    if (modbus_write_registers(station, CONTROL, 8, block) != 8) return -1;
    while (!(answers & ENDED)) {
        if (modbus_read_registers(station, HANDSHAKE, 1, &answers) != 1) return -1;
        usleep(POLL_US);
    }
    return modbus_write_registers(station, CONTROL, 8, none) == 8 ? 0 : -1;
}

int main(int argc, char **argv) {
    if (argc != 2) return 2;
    modbus_t *station = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    if (!station || modbus_set_slave(station, 1) || modbus_connect(station)) {
        fprintf(stderr, "connect: %s\n", modbus_strerror(errno));
        return 1;
    }
    uint16_t r[WORDS];
    int seen = -1, ordered_at = -1;
    while (modbus_read_input_registers(station, STATISTICS, WORDS, r) == WORDS) {
        const int sequence = r[0];
        const uint32_t age_ms = (uint32_t)r[8] << 16 | r[9];
        if (r[124] == sequence && sequence != seen) {
            seen = sequence;
            if (ordered_at >= 0) {
                if (((sequence - ordered_at) & 0xFFFF) >= SETTLE) {
                    ordered_at = -1;
                    if (reset(station)) break;
                }
            } else if ((r[1] & VALID) && age_ms <= 60000 && r[5] != 0xFFFF && r[5] >= 500 && act(sequence, r[4])) {
                ordered_at = sequence;
            }
        }
        usleep(POLL_US);
    }
    modbus_free(station);
    return 0;
}
