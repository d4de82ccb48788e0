/* A GigE Vision camera on 127.0.0.1 that nobody here wrote the protocol of: gige_camera FEATURES.xml SCENE.pgm [LOST]
 *
 * Shows SCENE (binary PGM, 8 bits, 640 x 480) as it is at an exposure of 1000 us, and brighter or darker in proportion,
 * clipped at the pixel format's largest value; gain multiplies by its value in dB. LOST is the share of packets that
 * the network swallows. "-" for FEATURES.xml takes the features of Aravis' own fake camera, with their older names.
 * Prints "ready" once it listens; each line that it reads then is a pulse on Line0. */
#include <arv.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { WIDTH = 640, HEIGHT = 480, FRAMES_PER_S = 1000 };

static volatile int pulse; /* a signal is on Line0, for which there is no frame yet */
static unsigned char scene[WIDTH * HEIGHT];

static int read_scene(const char *path)
{
    FILE *file = fopen(path, "rb");
    int width = 0, height = 0;
    int good = file && fscanf(file, "P5 %d %d 255", &width, &height) == 2 && fgetc(file) != EOF && width == WIDTH
        && height == HEIGHT && fread(scene, sizeof scene, 1, file) == 1;

    if (file)
        fclose(file);
    return good;
}

static unsigned reg(ArvFakeCamera *camera, unsigned address)
{
    guint32 value = 0;

    arv_fake_camera_read_register(camera, address, &value);
    return value;
}

static int bits_of(ArvPixelFormat format)
{
    switch (format) {
    case ARV_PIXEL_FORMAT_MONO_8:
        return 8;
    case ARV_PIXEL_FORMAT_MONO_10:
    case ARV_PIXEL_FORMAT_MONO_10_PACKED:
    case 0x010A0046: /* Mono10p */
        return 10;
    default:
        return 12;
    }
}

/* A value's place among the image's bits, lowest first. */
static void put(unsigned char *data, ArvPixelFormat format, size_t at, unsigned value, int bits)
{
    switch (format) {
    case ARV_PIXEL_FORMAT_MONO_8:
        data[at] = value;
        return;
    case ARV_PIXEL_FORMAT_MONO_10:
    case ARV_PIXEL_FORMAT_MONO_12:
        data[2 * at] = value & 0xFF;
        data[2 * at + 1] = value >> 8;
        return;
    case ARV_PIXEL_FORMAT_MONO_10_PACKED:
    case ARV_PIXEL_FORMAT_MONO_12_PACKED:
        data[at / 2 * 3 + (at % 2 ? 2 : 0)] = value >> (bits - 8);
        data[at / 2 * 3 + 1] |= (value & ((1u << (bits - 8)) - 1)) << (at % 2 ? 4 : 0);
        return;
    default:
        for (int bit = 0; bit < bits; bit++)
            data[(at * bits + bit) / 8] |= ((value >> bit) & 1u) << ((at * bits + bit) % 8);
    }
}

static void show(ArvBuffer *buffer, void *camera, guint32 exposure_us, guint32 gain_db, ArvPixelFormat format)
{
    size_t at = 0;
    unsigned char *data = (unsigned char *)arv_buffer_get_data(buffer, NULL);
    unsigned left = reg(camera, ARV_FAKE_CAMERA_REGISTER_X_OFFSET), top = reg(camera, ARV_FAKE_CAMERA_REGISTER_Y_OFFSET);
    unsigned width = reg(camera, ARV_FAKE_CAMERA_REGISTER_WIDTH), height = reg(camera, ARV_FAKE_CAMERA_REGISTER_HEIGHT);
    int bits = bits_of(format), largest = (1 << bits) - 1;
    double scale = exposure_us / 1000.0 * pow(10, gain_db / 20.0) * (1 << (bits - 8));

    if (pulse)
        arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_TRIGGER_SOURCE, 0);
    pulse = 0;
    memset(data, 0, arv_fake_camera_get_payload(camera));
    for (unsigned y = 0; y < height; y++)
        for (unsigned x = 0; x < width; x++) {
            int inside = top + y < HEIGHT && left + x < WIDTH;
            double value = inside ? scene[(top + y) * WIDTH + left + x] * scale : 0;
            put(data, format, at++, value < largest ? (unsigned)(value + 0.5) : largest, bits);
        }
}

int main(int argc, char **argv)
{
    if (argc < 3 || !read_scene(argv[2])) {
        fprintf(stderr, "gige_camera: no 640 x 480 PGM\n");
        return 1;
    }
    ArvGvFakeCamera *gige = arv_gv_fake_camera_new_full("127.0.0.1", "SCENE1", strcmp(argv[1], "-") ? argv[1] : NULL);
    ArvFakeCamera *camera = arv_gv_fake_camera_get_fake_camera(gige);

    if (!arv_gv_fake_camera_is_running(gige)) {
        fprintf(stderr, "gige_camera: port 3956 is taken\n");
        return 1;
    }
    if (argc > 3)
        g_object_set(gige, "gvsp-lost-ratio", atof(argv[3]), NULL);
    arv_fake_camera_set_fill_pattern(camera, show, camera);
    arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_WIDTH, WIDTH);
    arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_HEIGHT, HEIGHT);
    arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_SENSOR_WIDTH, WIDTH);
    arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_SENSOR_HEIGHT, HEIGHT);
    arv_fake_camera_set_trigger_frequency(camera, FRAMES_PER_S);
    arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_ACQUISITION_FRAME_PERIOD_US, 1000000 / FRAMES_PER_S);
    puts("ready");
    fflush(stdout);
    while (getchar() != EOF) { /* it ends with whoever started it */
        /* Aravis' camera knows no lines: for the time of one frame, this one is triggered by software. */
        pulse = 1;
        arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_TRIGGER_SOURCE, 1);
        arv_fake_camera_write_register(camera, ARV_FAKE_CAMERA_REGISTER_TRIGGER_SOFTWARE, 1);
    }
    return 0;
}
