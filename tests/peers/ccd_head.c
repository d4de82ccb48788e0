/* A CCD head written from the makers' manuals alone: ccd_head dalsa|jai PORT [FRAMES WIDTH HEIGHT]

   dalsa: "A carriage return ends each command. The camera will answer each command with either <CR><LF>OK > or Error
   x: Error Message >. The > is always the last character sent. Upper and lower case are accepted." Exposure outside
   40 to 4000000 us is clipped with a warning; set works in exposure modes 2 and 6 (Falcon XDR and HG, 3 and 3.7).
   jai: "NN=[Param.]<CR><LF>: COMPLETE<CR><LF>. NN?<CR><LF>: NN=0<CR><LF>. 01 Unknown Command!!, 02 Bad Parameters!!"
   (GO-5000M-PMCL-UV, Short ASCII Command Communication Protocol); PE works when SM=1 (CM-030PMCL-RH, 7.4).

   Prints "ready", then each command that it gets. With FRAMES, a named pipe, it writes one frame after another into it:
   every pixel is exposure / 100, at most 255. */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

static double exposure_us = 10000;
static int mode = 4, shutter = 0, trigger = 1;

static void dalsa(const char *line, char *answer) {
    double value;
    int asked;
    if (sscanf(line, "%*[sS]%*[eE]%*[tT] %lf", &value) == 1) {
        if (mode != 2 && mode != 6) strcpy(answer, "\r\nError 05: Command not available in current exposure mode >");
        else if (value < 40) exposure_us = 40, strcpy(answer, "\r\nWarning 02: Clipped to min>");
        else if (value > 4000000) exposure_us = 4000000, strcpy(answer, "\r\nWarning 03: Clipped to max>");
        else exposure_us = value, strcpy(answer, "\r\nOK >");
    } else if (strcasecmp(line, "get set") == 0) sprintf(answer, "\r\n%.3f\r\nOK >", exposure_us);
    else if (sscanf(line, "%*[sS]%*[eE]%*[mM] %d", &asked) == 1) {
        if (asked == 2 || asked == 4 || asked == 6) mode = asked, strcpy(answer, "\r\nOK >");
        else strcpy(answer, "\r\nError 04: Incorrect parameter value >");
    } else if (strcasecmp(line, "get sem") == 0) sprintf(answer, "\r\n%d\r\nOK >", mode);
    else strcpy(answer, "\r\nError 02: Unrecognized command>");
}

static void jai(const char *line, char *answer) {
    int value;
    if (sscanf(line, "PE=%d", &value) == 1) {
        if (value < 2 || value > 1000000 || !shutter) strcpy(answer, "02 Bad Parameters!!\r\n");
        else exposure_us = value, strcpy(answer, "COMPLETE\r\n");
    } else if (sscanf(line, "SM=%d", &value) == 1 && (value == 0 || value == 1)) shutter = value, strcpy(answer, "COMPLETE\r\n");
    else if (sscanf(line, "TR=%d", &value) == 1 && value >= 0 && value <= 2) trigger = value, strcpy(answer, "COMPLETE\r\n");
    else if (strcmp(line, "PE?") == 0) sprintf(answer, "PE=%.0f\r\n", exposure_us);
    else if (strcmp(line, "SM?") == 0) sprintf(answer, "SM=%d\r\n", shutter);
    else if (strcmp(line, "TR?") == 0) sprintf(answer, "TR=%d\r\n", trigger);
    else strcpy(answer, "01 Unknown Command!!\r\n");
}

static void show_frame(const char *path, size_t size) {
    static int pipe_fd = -1;
    static unsigned char *frame;
    size_t done = 0;
    if (!frame) frame = malloc(size);
    memset(frame, exposure_us / 100 > 255 ? 255 : (int)(exposure_us / 100), size);
    if (pipe_fd < 0 && (pipe_fd = open(path, O_WRONLY | O_NONBLOCK)) < 0) return;
    fcntl(pipe_fd, F_SETFL, 0);
    while (done < size) {
        ssize_t n = write(pipe_fd, frame + done, size - done);
        if (n < 0 && errno == EPIPE) { close(pipe_fd); pipe_fd = -1; return; }
        if (n > 0) done += n;
    }
}

int main(int argc, char **argv) {
    int is_dalsa = !strcmp(argv[1], "dalsa"), port = open(argv[2], O_RDWR | O_NOCTTY);
    size_t length = 0, size = argc > 5 ? (size_t)atoi(argv[4]) * atoi(argv[5]) : 0;
    char line[128], answer[128], byte;
    if (port < 0) return perror(argv[2]), 1;
    signal(SIGPIPE, SIG_IGN);
    puts("ready");
    fflush(stdout);
    for (;;) {
        struct pollfd waiting = {port, POLLIN, 0};
        if (poll(&waiting, 1, size ? 20 : -1) == 0) { show_frame(argv[3], size); continue; }
        if (read(port, &byte, 1) != 1) return 0;
        if (byte == (is_dalsa ? '\r' : '\n')) {
            while (length && line[length - 1] == '\r') length--;
            line[length] = 0;
            length = 0;
            printf("%s\n", line);
            fflush(stdout);
            (is_dalsa ? dalsa : jai)(line, answer);
            if (write(port, answer, strlen(answer)) < 0) return 0;
        } else if (byte != '\n' && length < sizeof line - 1) line[length++] = byte;
    }
}
