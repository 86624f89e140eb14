/* What libfreenect's fakenect lacks for its own OpenNI2 driver, which fails without these. */
#include "libfreenect.h"

int freenect_set_flag(freenect_device *device, freenect_flag flag, freenect_flag_value value) { return 0; }

freenect_frame_mode freenect_find_video_mode(freenect_resolution resolution, freenect_video_format format) {
  freenect_frame_mode mode = {256, resolution, {0}, 921600, 640, 480, 24, 0, 30, 0};
  mode.video_format = format;
  mode.is_valid = resolution == FREENECT_RESOLUTION_MEDIUM && format == FREENECT_VIDEO_RGB;
  return mode;
}

freenect_frame_mode freenect_find_depth_mode(freenect_resolution resolution, freenect_depth_format format) {
  freenect_frame_mode mode = {256, resolution, {0}, 614400, 640, 480, 16, 0, 30, 0};
  mode.depth_format = format;
  mode.is_valid = resolution == FREENECT_RESOLUTION_MEDIUM;
  return mode;
}

/* The driver opens each device once to read its USB numbers from libfreenect's own structures, which
   fakenect has none of. Its device is the number 1234. */
static int opened = 0;
int freenect_open_device(freenect_context *context, freenect_device **device, int index) {
  if (!opened++) return -1;
  *device = (freenect_device *)1234;
  return 0;
}
