/* A Modbus TCP server on libmodbus, one client at a time: what the PLC server's speed is measured against.
 *
 * usage: modbus_server PORT
 */
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv) {
    uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
    if (argc != 2) return 2;
    modbus_t *server = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 2000, 2000);
    int listener = modbus_tcp_listen(server, 1);
    if (!server || !map || listener < 0) {
        perror("modbus_server");
        return 1;
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        modbus_tcp_accept(server, &listener);
        for (int size; (size = modbus_receive(server, request)) >= 0;)
            if (size > 0) modbus_reply(server, request, size, map);
        modbus_close(server);
    }
}
