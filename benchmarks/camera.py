"""A camera in a process of its own: it shows the images of a clip at a fixed rate.

    python -m benchmarks.camera FOLDER TRANSPORT RATE IMAGES SUBSCRIBERS [BAG TOPIC]

It publishes `camera_info` and `image`, or `image/compressed`, as drivers do, as sensor data, once
that many subscribers listen; behind each image the message of its number on a topic of a bag, if
one is named. The first images are shown back and forth until a line comes on standard input; from
then on the clip goes on. On standard output it then says by how much the stamps of the
clip are later than in its bag, ns, and when its first image is due by the monotonic clock, ns. At
the end it says how late the latest image was published, ns, and stays until another line comes.
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

# Images that are shown before the clip goes on.
SWAYING = 4
# Where the stamp of a header stands that opens a message, behind the encapsulation.
_STAMP_AT = 4


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """A message that opens with a header, with another stamp."""
    stamp = struct.pack('<iI', *divmod(stamp_ns, 10**9))
    return data[:_STAMP_AT] + stamp + data[_STAMP_AT + len(stamp) :]


def main(argv: list[str]) -> int:
    """Shows the clip once."""
    folder, transport = Path(argv[0]), argv[1]
    rate, count, subscribers = float(argv[2]), int(argv[3]), int(argv[4])
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    info, images = read_messages(folder, [COMPRESSED], count)
    # A clip that is shorter is shown back and forth.
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
        """Publishes an image when it is due; how late that was, ns."""
        while (left := due - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)
        late = time.monotonic_ns() - due
        publisher.publish(with_stamp(data, stamp))
        calibrations.publish(with_stamp(calibration, stamp))
        if detections is not None:
            detections.publish(with_stamp(more[number], stamp))
        return late

    # A picture that never changes is no evidence of a person, who sways.
    first, shown = [content(number) for number in range(min(SWAYING, len(images)))], 0
    start, shift = time.monotonic_ns(), 0
    while not select.select([sys.stdin], [], [], 0)[0]:
        number = index_back_and_forth(shown, len(first))
        publish(number, first[number], stamps[0] + shift, start + shift)
        shown, shift = shown + 1, shift + step
    sys.stdin.readline()
    start += shift
    print(shift, start, flush=True)
    # A picture is made before it is due, as by a driver.
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
