"""A camera in a process of its own: it shows the images of a clip at a rate, whoever keeps up.

    python -m benchmarks.camera FOLDER TRANSPORT RATE IMAGES SUBSCRIBERS

It publishes `camera_info` and `image`, or `image/compressed`, as drivers do, as sensor data, once
that many subscribers listen. The first image is repeated until a line comes on standard input; from
then on the clip moves. On standard output it then says by how much the stamps of the clip are later
than in its bag, ns, and when its first image is due by the monotonic clock, ns. At the end it says
how late the latest image was published, ns, and stays until another line comes.
"""

from __future__ import annotations

import select
import sys
import time
from pathlib import Path

from benchmarks.clips import COMPRESSED, read_messages
from benchmarks.publisher import with_stamp
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image, image_message


def main(argv: list[str]) -> int:
    """Shows the clip once."""
    folder, transport = Path(argv[0]), argv[1]
    rate, count, subscribers = float(argv[2]), int(argv[3]), int(argv[4])
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    info, images = read_messages(folder, [COMPRESSED], count)
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
    while publisher.get_subscription_count() < subscribers:
        time.sleep(0.01)

    def publish(data: bytes, stamp: int, due: int) -> int:
        """Publishes an image when it is due; how late that was, ns."""
        while (left := due - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)
        late = time.monotonic_ns() - due
        publisher.publish(with_stamp(data, stamp))
        calibrations.publish(with_stamp(calibration, stamp))
        return late

    still, start, shift = content(0), time.monotonic_ns(), 0
    while not select.select([sys.stdin], [], [], 0)[0]:
        publish(still, stamps[0] + shift, start + shift)
        shift += step
    sys.stdin.readline()
    start += shift
    print(shift, start, flush=True)
    # A picture is made before it is due, as by a driver.
    late = [
        publish(content(number), stamp + shift, start + stamp - stamps[0])
        for number, stamp in enumerate(stamps)
    ]
    print(max(late), flush=True)
    sys.stdin.readline()
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
