/* A PLC on libmodbus: holding registers that a station writes its result block into.
 *
 * usage: plc_registers PORT BASE ACKNOWLEDGE LAST
 *   PORT 0 takes any free one; BASE: where the block begins; ACKNOWLEDGE: the register in which it puts the sequence of
 *   the result that it took, -1 for none; LAST: the sequence it took before it was switched off (retentive).
 * stdout: "port N", then a line for each result taken: sequence, verdict, largest height, overruns, results waiting;
 *   and "live STATE FAULT HEARTBEAT" whenever one of these changes.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

enum { SEQUENCE, MAP_VERSION, HEARTBEAT, STATE, FAULT = 5, VERDICT = 6, HEIGHT = 11, OVERRUNS = 35, WAITING = 46, END = 124 };

/* Do what is asked and keep the answer from the wire; its length. It goes out once what was done is recorded: killed in
 * between, this PLC has not said yes to what nobody will know of. */
static int answered(modbus_t *slave, const uint8_t *query, int length, modbus_mapping_t *map, const int kept[2], uint8_t *answer) {
    int wire = modbus_get_socket(slave);
    modbus_set_socket(slave, kept[0]);
    int replied = modbus_reply(slave, query, length, map);
    modbus_set_socket(slave, wire);
    return replied < 0 ? replied : (int)recv(kept[1], answer, MODBUS_TCP_MAX_ADU_LENGTH, 0);
}

int main(int argc, char **argv) {
    if (argc != 5) {
        fprintf(stderr, "usage: %s PORT BASE ACKNOWLEDGE LAST\n", argv[0]);
        return 2;
    }
    int base = atoi(argv[2]), acknowledge = atoi(argv[3]);
    uint16_t last = atoi(argv[4]), live[3] = {0, 0, 0};
    modbus_t *slave = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    modbus_mapping_t *map = modbus_mapping_new(0, 0, base + 500, 0);
    int listener = modbus_tcp_listen(slave, 1);
    int kept[2];
    if (listener < 0 || socketpair(AF_UNIX, SOCK_SEQPACKET, 0, kept) < 0) {
        fprintf(stderr, "listen: %s\n", modbus_strerror(errno));
        return 1;
    }
    struct sockaddr_in bound;
    socklen_t size = sizeof bound;
    getsockname(listener, (struct sockaddr *)&bound, &size);
    printf("port %d\n", ntohs(bound.sin_port));
    fflush(stdout);
    uint16_t *block = map->tab_registers + base;
    if (acknowledge >= 0) map->tab_registers[acknowledge] = last;
    while (modbus_tcp_accept(slave, &listener) >= 0) {
        uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH], answer[MODBUS_TCP_MAX_ADU_LENGTH];
        int length;
        while ((length = modbus_receive(slave, query)) >= 0) {
            if (length > 0 && (length = answered(slave, query, length, map, kept, answer)) < 0) break;
            uint16_t now[3] = {block[STATE], block[FAULT], block[HEARTBEAT]};
            if (memcmp(now, live, sizeof now) != 0) printf("live %u %u %u\n", now[0], now[1], now[2]);
            memcpy(live, now, sizeof live);
            if (block[MAP_VERSION] && block[SEQUENCE] == block[END] && block[SEQUENCE] != last) {
                last = block[SEQUENCE];
                printf("%u %u %u %u %u\n", last, block[VERDICT], block[HEIGHT], block[OVERRUNS], block[WAITING]);
            }
            fflush(stdout);
            if (acknowledge >= 0) map->tab_registers[acknowledge] = last;
            if (length > 0 && send(modbus_get_socket(slave), answer, length, MSG_NOSIGNAL) < 0) break;
        }
        modbus_close(slave);
    }
    return 0;
}
