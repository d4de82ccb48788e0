/* A Modbus RTU slave that nobody here wrote the protocol of: module_slave PORT UNIT [ADDRESS=VALUE | FROM:TO]...
 *
 * 2048 points of each table, zero but for holding registers given as ADDRESS=VALUE; holding register FROM is copied
 * to input register TO after each request, as a module's read-back. Prints "ready" once it listens. */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>

enum { POINTS = 2048 };

static void prepare(modbus_mapping_t *map, int count, char **options, int copying)
{
    for (int i = 0; i < count; i++) {
        int left, right;
        if (!copying && sscanf(options[i], "%d=%d", &left, &right) == 2)
            map->tab_registers[left] = right;
        if (copying && sscanf(options[i], "%d:%d", &left, &right) == 2)
            map->tab_input_registers[right] = map->tab_registers[left];
    }
}

int main(int argc, char **argv)
{
    uint8_t request[MODBUS_RTU_MAX_ADU_LENGTH];
    modbus_t *bus = modbus_new_rtu(argv[1], 9600, 'N', 8, 1);
    modbus_mapping_t *map = modbus_mapping_new(POINTS, POINTS, POINTS, POINTS);

    if (argc < 3 || !bus || !map || modbus_set_slave(bus, atoi(argv[2])) || modbus_connect(bus)) {
        fprintf(stderr, "module_slave: %s\n", modbus_strerror(errno));
        return 1;
    }
    prepare(map, argc - 3, argv + 3, 0);
    puts("ready");
    fflush(stdout);
    for (;;) {
        int size = modbus_receive(bus, request);
        if (size == -1 && errno == EIO)
            return 0;
        if (size > 0)
            modbus_reply(bus, request, size, map);
        prepare(map, argc - 3, argv + 3, 1);
    }
}
