"""Size limits of files and their parts; what is larger is refused before memory is allocated for it.

They are far above what depth cameras produce, and low enough for a computer with 4 GB. A file from elsewhere
can declare any size.
"""

#: Pixels of one image, or points of one cloud: 4096 x 4096. The color images of an Azure Kinect, the largest
#: of such cameras, have 4096 x 3072.
PIXELS_MAX = 1 << 24
#: Bytes of one frame's file (an image, a cloud), and of what one cloud holds: 256 MiB.
FRAME_BYTES_MAX = 1 << 28
#: Bytes of one chunk or message of an MCAP file, compressed and not: 128 MiB, two of the largest images.
CHUNK_BYTES_MAX = 1 << 27
#: Records in one chunk of an MCAP file; a writer's chunk of some megabytes holds thousands.
CHUNK_RECORDS_MAX = 1 << 18
#: Bytes of a schema, channel, metadata or statistics record of an MCAP file: 16 MiB.
RECORD_BYTES_MAX = 1 << 24
#: Bytes of the first messages of topics, which are kept: 128 MiB; and of transforms: 8 MiB.
SAMPLES_BYTES_MAX = 1 << 27
TRANSFORMS_BYTES_MAX = 1 << 23
#: Bytes and lines of a list of images by time: 16 MiB, four hours at 30 Hz.
LIST_BYTES_MAX = 1 << 24
LIST_LINES_MAX = 500_000
#: Bytes of a calibration or configuration file, 256 KiB; the values of a YAML file and their nesting.
TEXT_BYTES_MAX = 1 << 18
TEXT_VALUES_MAX = 50_000
TEXT_DEPTH_MAX = 16
#: Stamps are from 0 to here, nanoseconds: ROS keeps the seconds in 32 bits.
STAMP_END_NS = (1 << 31) * 1_000_000_000
