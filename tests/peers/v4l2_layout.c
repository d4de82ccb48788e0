/* Prints what linux/videodev2.h itself says of the structures and requests that frames are asked for with. */
#include <linux/videodev2.h>
#include <stddef.h>
#include <stdio.h>

#define SHOW(name, value) printf("%s %lu\n", name, (unsigned long)(value))

int main(void) {
    SHOW("FORMAT", sizeof(struct v4l2_format));
    SHOW("REQUEST", sizeof(struct v4l2_requestbuffers));
    SHOW("BUFFER", sizeof(struct v4l2_buffer));
    SHOW("SET_FORMAT", VIDIOC_S_FMT);
    SHOW("REQUEST_BUFFERS", VIDIOC_REQBUFS);
    SHOW("QUERY_BUFFER", VIDIOC_QUERYBUF);
    SHOW("QUEUE_BUFFER", VIDIOC_QBUF);
    SHOW("TAKE_BUFFER", VIDIOC_DQBUF);
    SHOW("STREAM_ON", VIDIOC_STREAMON);
    SHOW("STREAM_OFF", VIDIOC_STREAMOFF);
    SHOW("CAPTURE", V4L2_BUF_TYPE_VIDEO_CAPTURE);
    SHOW("MEMORY_MAP", V4L2_MEMORY_MMAP);
    SHOW("FIELD_NONE", V4L2_FIELD_NONE);
    SHOW("FLAG_ERROR", V4L2_BUF_FLAG_ERROR);
    SHOW("GREY", V4L2_PIX_FMT_GREY);
    SHOW("Y16", V4L2_PIX_FMT_Y16);
    SHOW("pix.width", offsetof(struct v4l2_format, fmt.pix.width));
    SHOW("pix.pixelformat", offsetof(struct v4l2_format, fmt.pix.pixelformat));
    SHOW("pix.field", offsetof(struct v4l2_format, fmt.pix.field));
    SHOW("pix.bytesperline", offsetof(struct v4l2_format, fmt.pix.bytesperline));
    SHOW("bytesused", offsetof(struct v4l2_buffer, bytesused));
    SHOW("flags", offsetof(struct v4l2_buffer, flags));
    SHOW("sequence", offsetof(struct v4l2_buffer, sequence));
    SHOW("memory", offsetof(struct v4l2_buffer, memory));
    SHOW("offset", offsetof(struct v4l2_buffer, m.offset));
    SHOW("length", offsetof(struct v4l2_buffer, length));
    return 0;
}
