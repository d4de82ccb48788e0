/* A Modbus TCP client on libmodbus that mostly reads, as PLCs do, and checks every word of every answer.
 *
 * usage: modbus_mixed HOST PORT REQUESTS TEMPLATE CONTROL
 * TEMPLATE has a line "address kind value" for each register: n holds the number of the image, c the value, x anything.
 * Four registers from CONTROL on are this client's own to write. Prints how many requests were answered as they should
 * be; or what was wrong, with exit status 1.
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { OWN = 4, LONGEST = 125, ABSENT = 200, BITS = 16 };

static char kind[65536];
static uint16_t value[65536];
static uint16_t own[OWN];

static int fail(long request, const char *what, int address) {
    fprintf(stderr, "request %ld: %s at %d (%s)\n", request, what, address, modbus_strerror(errno));
    exit(1);
}

static void check(long request, int address, int count, const uint16_t *words) {
    int number = -1;
    for (int i = 0; i < count; i++) {
        char k = kind[address + i];
        if (k == 'n' && number < 0) number = words[i];
        if (k == 'n' && words[i] != number) fail(request, "torn", address + i);
        if (k == 'c' && words[i] != value[address + i]) fail(request, "wrong", address + i);
    }
}

static void check_own(long request, int control, const uint16_t *words) {
    if (memcmp(words, own, sizeof own)) fail(request, "not as written", control);
}

static void check_own_bits(long request, int control, const uint8_t *bits) {
    for (int i = 0; i < OWN * BITS; i++)
        if (bits[i] != (own[i / BITS] >> i % BITS & 1)) fail(request, "bit not as written", control * BITS + i);
}

static int ask(modbus_t *client, long i, int control) {
    uint16_t words[LONGEST];
    uint8_t bits[OWN * BITS];
    int at = (int)(i * 7 % 100), count = 1 + (int)(i % 25);
    switch (i % 8 < 7 ? i % 7 : 7 + i / 8 % 8) {
    case 0:
    case 1:
        if (modbus_read_input_registers(client, 0, LONGEST, words) != LONGEST) fail(i, "read", 0);
        check(i, 0, LONGEST, words);
        break;
    case 2:
    case 3:
        if (modbus_read_registers(client, 0, LONGEST, words) != LONGEST) fail(i, "read", 0);
        check(i, 0, LONGEST, words);
        break;
    case 4:
        if (modbus_read_registers(client, 1000, LONGEST, words) != LONGEST) fail(i, "read", 1000);
        check(i, 1000, LONGEST, words);
        break;
    case 5:
        if (modbus_read_input_registers(client, at, count, words) != count) fail(i, "read", at);
        check(i, at, count, words);
        break;
    case 6:
        if (modbus_read_registers(client, control, OWN, words) != OWN) fail(i, "read", control);
        check_own(i, control, words);
        break;
    case 7:
        for (int k = 0; k < OWN; k++) own[k] = (uint16_t)(i + k);
        if (modbus_write_registers(client, control, OWN, own) != OWN) fail(i, "write", control);
        break;
    case 8:
        own[1] = (uint16_t)(own[1] * 3);
        if (modbus_write_register(client, control + 1, own[1]) != 1) fail(i, "write", control + 1);
        break;
    case 9:
        own[2] = (uint16_t)((own[2] & 0xF0F0) | (0x0505 & ~0xF0F0));
        if (modbus_mask_write_register(client, control + 2, 0xF0F0, 0x0505) != 1) fail(i, "mask", control + 2);
        break;
    case 10:
        own[3] = (uint16_t)i;
        if (modbus_write_and_read_registers(client, control + 3, 1, own + 3, control, OWN, words) != OWN)
            fail(i, "write and read", control);
        check_own(i, control, words);
        break;
    case 11:
        for (int k = 0; k < 20; k++) bits[k] = (uint8_t)(i >> k & 1);
        for (int k = 0; k < 20; k++)
            own[1 + (k + 3) / BITS] = (uint16_t)((own[1 + (k + 3) / BITS] & ~(1 << (k + 3) % BITS)) | bits[k] << (k + 3) % BITS);
        if (modbus_write_bits(client, (control + 1) * BITS + 3, 20, bits) != 20) fail(i, "write bits", control + 1);
        if (modbus_read_input_bits(client, control * BITS, OWN * BITS, bits) != OWN * BITS) fail(i, "read", control);
        check_own_bits(i, control, bits);
        return 2;
    case 12:
        own[0] ^= 0x0080;
        if (modbus_write_bit(client, control * BITS + 7, own[0] >> 7 & 1) != 1) fail(i, "write bit", control);
        if (modbus_read_bits(client, control * BITS, OWN * BITS, bits) != OWN * BITS) fail(i, "read bits", control);
        check_own_bits(i, control, bits);
        return 2;
    default:
        if (modbus_read_registers(client, ABSENT, 1, words) != -1 || errno != EMBXILADD) fail(i, "no refusal", ABSENT);
        if (modbus_read_bits(client, ABSENT * BITS, 1, bits) != -1 || errno != EMBXILADD) fail(i, "no refusal", 0);
        return 2;
    }
    return 1;
}

int main(int argc, char **argv) {
    if (argc != 6) return 2;
    FILE *template = fopen(argv[4], "r");
    int address, number;
    char k;
    while (template && fscanf(template, "%d %c %d", &address, &k, &number) == 3)
        kind[address] = k, value[address] = (uint16_t)number;
    modbus_t *client = modbus_new_tcp_pi(argv[1], argv[2]);
    modbus_set_response_timeout(client, 20, 0);
    if (modbus_connect(client)) fail(0, "connect", 0);
    long asked = 0, wanted = atol(argv[3]);
    for (long i = 0; asked < wanted; i++) asked += ask(client, i, atoi(argv[5]));
    printf("%ld\n", asked);
    return 0;
}
