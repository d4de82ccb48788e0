/* The PLC's reads, answered without the interpreter: while Python inspects, a poll waits for nobody's lock.
 *
 * plc_wait waits on an epoll and answers, of connections marked direct, whole requests to read registers (functions 3
 * and 4) that lie within one area of what plc_show was given last. Whatever else there is goes to the caller, with the
 * bytes received so far: refusals, other functions, requests in pieces, newcomers, connections that end.
 *
 * Sources: MODBUS Application Protocol Specification V1.1b3, 6.3 and 6.4; MODBUS Messaging on TCP/IP Implementation
 * Guide V1.0b, 3.1.3.
 */
#include <errno.h>
#include <pthread.h>
#include <stdint.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>

typedef int64_t i64;
typedef uint8_t u8;

enum {
    DESCRIPTORS = 4096,
    RECEIVE_BYTES = 4096,
    REQUEST_BYTES = 12,
    HEADER_BYTES = 9, /* of an answer: MBAP, function, byte count */
    MOST_REGISTERS = 125,
    SEND_BYTES = RECEIVE_BYTES / REQUEST_BYTES * (HEADER_BYTES + 2 * MOST_REGISTERS),
    AREAS = 16,
    IMAGE_BYTES = 16384,
    EVENTS = 64
};

enum { TIME_OUT, READY, RECEIVED, UNSENT }; /* what plc_wait returns; plc_direct.py names them too */

typedef struct {
    pthread_mutex_t lock; /* held for one copy */
    int areas;
    struct { int address, count, at; } area[AREAS];
    u8 image[IMAGE_BYTES];
} Published; /* what every client reads, in C or through Python: a new image is there for all of them at once */

typedef struct {
    /* The caller's part: plc_direct.py lays it out alike. */
    i64 descriptor, size; /* what plc_wait returned for, and how many bytes, or minus errno */
    i64 requests;         /* answered here so far */
    double heard_s[DESCRIPTORS];
    i64 answered[DESCRIPTORS];
    u8 direct[DESCRIPTORS];
    u8 unit[256];
    u8 in[RECEIVE_BYTES];
    u8 out[SEND_BYTES];
    /* Ours. */
    Published *published;
    int events, next;
    struct epoll_event event[EVENTS];
} Plc;

i64 plc_published_bytes(void) { return sizeof(Published); }

i64 plc_bytes(void) { return sizeof(Plc); }

void plc_published_begin(Published *published) { pthread_mutex_init(&published->lock, NULL); }

void plc_begin(Plc *plc, Published *published) { plc->published = published; }

/* From now on show these: `areas` pairs of first address and count, and their registers one after the other, big-endian.
 * Returns 0, or -1 if there is no room for them. */
i64 plc_show(Published *published, i64 areas, const i64 *spans, const u8 *registers) {
    i64 bytes = 0;
    for (i64 i = 0; i < areas; i++) bytes += 2 * spans[2 * i + 1];
    if (areas > AREAS || bytes > IMAGE_BYTES) return -1;
    pthread_mutex_lock(&published->lock);
    int at = 0;
    for (int i = 0; i < areas; i++) {
        published->area[i].address = (int)spans[2 * i];
        published->area[i].count = (int)spans[2 * i + 1];
        published->area[i].at = at;
        at += 2 * published->area[i].count;
    }
    published->areas = (int)areas;
    memcpy(published->image, registers, at);
    pthread_mutex_unlock(&published->lock);
    return 0;
}

/* Copy registers of what is shown, big-endian; whether they lie within one area. */
i64 plc_read(Published *published, i64 address, i64 count, u8 *to) {
    int found = 0;
    pthread_mutex_lock(&published->lock);
    for (int i = 0; i < published->areas && !found; i++) {
        i64 first = address - published->area[i].address;
        found = first >= 0 && first + count <= published->area[i].count;
        if (found) memcpy(to, published->image + published->area[i].at + 2 * first, 2 * count);
    }
    pthread_mutex_unlock(&published->lock);
    return found;
}

/* Bytes of the answer to one request; 0 if it is none of those answered here. */
static int answered(Plc *plc, const u8 *request, u8 *answer) {
    static const u8 length[] = {0, 0, 0, 6};
    int function = request[7], address = request[8] << 8 | request[9], count = request[10] << 8 | request[11];
    if (memcmp(request + 2, length, sizeof length) || !plc->unit[request[6]]) return 0;
    if ((function != 3 && function != 4) || count < 1 || count > MOST_REGISTERS) return 0;
    if (!plc_read(plc->published, address, count, answer + HEADER_BYTES)) return 0;
    memcpy(answer, request, 4);
    answer[4] = 0;
    answer[5] = (u8)(3 + 2 * count);
    answer[6] = request[6];
    answer[7] = (u8)function;
    answer[8] = (u8)(2 * count);
    return HEADER_BYTES + 2 * count;
}

/* Bytes of the answers to all of `size` bytes received; 0 if anything among them is not for here. */
static int answers(Plc *plc, int size) {
    int at = 0, out = 0, one = 1;
    if (size % REQUEST_BYTES) return 0;
    for (; at < size && one; at += REQUEST_BYTES, out += one) one = answered(plc, plc->in + at, plc->out + out);
    return one ? out : 0;
}

static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Read a direct connection and answer it; what is left for the caller, TIME_OUT for nothing. */
static int attend(Plc *plc, int descriptor) {
    i64 size = recv(descriptor, plc->in, RECEIVE_BYTES, MSG_DONTWAIT);
    if (size < 0 && (errno == EAGAIN || errno == EINTR)) return TIME_OUT;
    plc->size = size < 0 ? -errno : size;
    int out = size > 0 ? answers(plc, (int)size) : 0;
    if (!out) return RECEIVED;
    plc->heard_s[descriptor] = now_s();
    plc->answered[descriptor] += size / REQUEST_BYTES;
    plc->requests += size / REQUEST_BYTES;
    i64 sent = send(descriptor, plc->out, out, MSG_DONTWAIT | MSG_NOSIGNAL);
    if (sent == out) return TIME_OUT;
    if (sent < 0 && errno != EAGAIN && errno != EINTR) {
        plc->size = -errno;
        return RECEIVED;
    }
    if (sent > 0) memmove(plc->out, plc->out + sent, out - sent);
    plc->size = out - (sent > 0 ? sent : 0);
    return UNSENT;
}

/* Answer until there is something for the caller, at most for so many seconds. Events that came together are gone
 * through before new ones are asked for, so that nobody's turn is lost. */
i64 plc_wait(Plc *plc, i64 epoll, double seconds) {
    double until_s = now_s() + seconds;
    for (int asked = 0;; asked = 1) {
        while (plc->next < plc->events) {
            int descriptor = plc->event[plc->next++].data.fd, left = READY;
            if (descriptor < DESCRIPTORS && plc->direct[descriptor]) left = attend(plc, descriptor);
            plc->descriptor = descriptor;
            if (left != TIME_OUT) return left;
        }
        double left_s = until_s - now_s();
        plc->next = plc->events = 0;
        if (asked && left_s <= 0) return TIME_OUT;
        int came = epoll_wait((int)epoll, plc->event, EVENTS, left_s > 0 ? (int)(1000 * left_s) + 1 : 0);
        if (came > 0) plc->events = came;
    }
}
