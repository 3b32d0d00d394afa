"""A camera process that publishes the images of a clip at a fixed rate.

    python -m benchmarks.camera FOLDER TRANSPORT RATE IMAGES SUBSCRIBERS [BAG TOPIC]

It publishes `camera_info` and `image`, or `image/compressed`, with the sensor-data QoS of drivers,
once there are SUBSCRIBERS; after each image also the message with its index from TOPIC of BAG, if
given. The first images are repeated back and forth until a line arrives on standard input; then the
clip plays. On standard output it prints the shift of the clip's timestamps against its bag, ns, and
the due time of its first image by the monotonic clock, ns. At the end it prints the maximum delay
of an image, ns, and waits for another line.
"""

from __future__ import annotations

import select
import struct
import sys
import time
from importlib import import_module
from pathlib import Path

from benchmarks.clips import COMPRESSED, index_back_and_forth, read_messages
from msg_tools import BagReader, RosbagsMessages
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image, image_message

# Number of images that are repeated before the clip starts.
SWAYING = 4
# Offset of the timestamp in a message that begins with a header, after the encapsulation.
_STAMP_AT = 4


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """A serialised message that begins with a header, with another timestamp."""
    stamp = struct.pack('<iI', *divmod(stamp_ns, 10**9))
    return data[:_STAMP_AT] + stamp + data[_STAMP_AT + len(stamp) :]


def main(argv: list[str]) -> int:
    """Publishes the clip once."""
    folder, transport = Path(argv[0]), argv[1]
    rate, count, subscribers = float(argv[2]), int(argv[3]), int(argv[4])
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    info, images = read_messages(folder, [COMPRESSED], count)
    # A shorter clip is repeated back and forth.
    indices = [index_back_and_forth(number, len(images)) for number in range(count)]
    stamps, frame = [time_ns(image.header.stamp) for image in images], images[0].header.frame_id
    step, calibration = round(1e9 / rate), serialise(info)

    def content(number: int) -> bytes:
        if transport == 'compressed':
            return serialise(images[number])
        picture = decode_image(images[number])
        return serialise(image_message(RosbagsMessages(), picture, stamps[number], str(frame)))

    rclpy.init()
    node = rclpy.create_node('camera')
    kind, topic = (Image, 'image') if transport == 'raw' else (CompressedImage, 'image/compressed')
    publisher = node.create_publisher(kind, topic, qos_profile_sensor_data)
    calibrations = node.create_publisher(CameraInfo, 'camera_info', qos_profile_sensor_data)
    more, detections = [], None
    if len(argv) > 5:
        with BagReader(Path(argv[5])) as bag:
            package, _, name = bag.topics[f'/{argv[6]}'].msgtype.split('/')
            kind = getattr(import_module(f'{package}.msg'), name)
            more = [serialise(stored.message) for stored in bag.messages([argv[6]])]
        detections = node.create_publisher(kind, argv[6], qos_profile_sensor_data)
    while publisher.get_subscription_count() < subscribers:
        time.sleep(0.01)

    def publish(number: int, data: bytes, stamp: int, due: int) -> int:
        """Publishes an image when it is due; returns its delay, ns."""
        while (left := due - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)
        late = time.monotonic_ns() - due
        publisher.publish(with_stamp(data, stamp))
        calibrations.publish(with_stamp(calibration, stamp))
        if detections is not None:
            detections.publish(with_stamp(more[number], stamp))
        return late

    # Several images are repeated, because a person always sways a little.
    first, shown = [content(number) for number in range(min(SWAYING, len(images)))], 0
    start, shift = time.monotonic_ns(), 0
    while not select.select([sys.stdin], [], [], 0)[0]:
        number = index_back_and_forth(shown, len(first))
        publish(number, first[number], stamps[0] + shift, start + shift)
        shown, shift = shown + 1, shift + step
    sys.stdin.readline()
    start += shift
    print(shift, start, flush=True)
    # An image is prepared before it is due, as by a driver.
    late = 0
    for number, index in enumerate(indices):
        after = stamps[index] - stamps[0] if number == index else number * step
        published = publish(index, content(index), stamps[0] + shift + after, start + after)
        late = max(late, published)
    print(late, flush=True)
    sys.stdin.readline()
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
