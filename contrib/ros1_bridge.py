#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Bridge from ROS 1: poses to a pose feed, and keyframes to a server. README.md beside it explains the use.

The feed needs rospy, tf2_ros and pyzmq (Debian: python3-rospy python3-tf2-ros python3-zmq); keyframes also
need tsfusion in the same Python.
"""

import argparse
import collections
import json
import math
import sys
import threading

import roslib.message
import rospy
import tf2_ros
import zmq
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import CameraInfo, Image

DTYPES = {
    "16UC1": ("<u2", 1),
    "mono16": ("<u2", 1),
    "32FC1": ("<f4", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
}


class Bridge:
    """Poses of `args.camera` in `args.world`, from tf or from one topic; tf2's buffer interpolates both."""

    def __init__(self, args):
        self.args, self.lock, self.last = args, threading.Lock(), None
        self.buffer = tf2_ros.Buffer(rospy.Duration(30))
        self.feed, self.client = None, None
        self.colors, self.info = collections.deque(maxlen=30), None
        if args.feed:
            self.feed = zmq.Context.instance().socket(zmq.PUB)
            (self.feed.connect if args.connect else self.feed.bind)(args.feed)
        if args.server:
            import tsfusion

            self.client = tsfusion.Client(args.server, spool=args.spool, map=args.map)
            rospy.Subscriber(args.depth, Image, self.on_depth, queue_size=30)
            if args.color:
                rospy.Subscriber(args.color, Image, self.colors.append, queue_size=30)
        if args.pose:
            rospy.Subscriber(args.pose, rospy.AnyMsg, self.on_pose, queue_size=100)
        else:
            self.listener = tf2_ros.TransformListener(self.buffer)
        rospy.Subscriber(args.camera_info, CameraInfo, self.on_info, queue_size=30)

    def on_pose(self, raw):
        """Publish a PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped."""
        message = roslib.message.get_message_class(raw._connection_header["type"])()
        message.deserialize(raw._buff)
        pose = getattr(message, "pose", None) or message.transform
        pose = getattr(pose, "pose", pose)
        transform = TransformStamped()
        transform.header.stamp = message.header.stamp
        transform.header.frame_id, transform.child_frame_id = self.args.world, self.args.camera
        transform.transform.translation = getattr(pose, "position", None) or pose.translation
        transform.transform.rotation = getattr(pose, "orientation", None) or pose.rotation
        self.buffer.set_transform(transform, "bridge")
        self.publish(message.header.stamp, transform.transform)

    def on_info(self, message):
        """Keep the camera's calibration; with tf, publish the pose at its timestamp."""
        self.info = message
        if not self.args.pose:
            self.publish(message.header.stamp, self.pose_at(message.header.stamp))

    def pose_at(self, stamp):
        """Look up the camera's pose, waiting 0.2 s at most; None where tf does not know it."""
        try:
            found = self.buffer.lookup_transform(
                self.args.world, self.args.camera, stamp, rospy.Duration(0.2)
            )
        except tf2_ros.TransformException as error:
            rospy.logwarn_throttle(5, f"no pose: {error}")
            return None
        return found.transform

    def publish(self, stamp, pose):
        """Send one message of the feed."""
        if self.feed is None:
            return
        message = {"stamp_ns": stamp.to_nsec()}
        message.update({"lost": True} if pose is None else {"pose": numbers(pose)})
        with self.lock:  # callbacks come from several threads
            self.feed.send(json.dumps(message).encode())

    def on_depth(self, message):
        """Send a keyframe every `--distance` metres or `--angle` degrees."""
        pose = None if self.info is None else self.pose_at(message.header.stamp)
        if pose is None or not self.moved(numbers(pose)):
            return
        from tsfusion import Intrinsics, Keyframe

        K, stamp = self.info.K, message.header.stamp
        near = [color for color in list(self.colors) if abs((color.header.stamp - stamp).to_sec()) < 0.02]
        self.client.send(
            Keyframe(
                T_world_camera=matrix(numbers(pose)),
                depth=array(message),  # uint16 millimetres or float32 metres
                intrinsics=Intrinsics(K[0], K[4], K[2], K[5]),
                color=array(near[-1]) if near else None,
                timestamp_ns=stamp.to_nsec(),
            )
        )
        self.last = numbers(pose)

    def moved(self, pose):
        """Whether a pose is far enough from the last keyframe's."""
        if self.last is None:
            return True
        cosine = abs(sum(a * b for a, b in zip(pose[3:], self.last[3:], strict=True)))
        turned = math.degrees(2 * math.acos(min(1.0, cosine)))
        return math.dist(pose[:3], self.last[:3]) > self.args.distance or turned > self.args.angle


def numbers(pose):
    """Convert a pose to tx ty tz qx qy qz qw."""
    t, q = pose.translation, pose.rotation
    return [t.x, t.y, t.z, q.x, q.y, q.z, q.w]


def matrix(pose):
    """Convert seven numbers to a (4, 4) T_world_camera."""
    import numpy as np

    x, y, z, w = np.array(pose[3:]) / math.hypot(*pose[3:])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), pose[0]],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), pose[1]],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), pose[2]],
            [0, 0, 0, 1],
        ]
    )


def array(image):
    """Convert a sensor_msgs/Image to (H, W), or (H, W, 3) BGR."""
    import numpy as np

    kind, channels = DTYPES[image.encoding]
    rows = np.frombuffer(image.data, np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<"))
    rows = rows.reshape(image.height, -1)[:, : image.width * channels].astype(np.dtype(kind))
    pixels = rows if channels == 1 else rows.reshape(image.height, image.width, channels)
    return np.ascontiguousarray(pixels[..., ::-1] if image.encoding == "rgb8" else pixels)


def main():
    """Run until ROS ends."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pose", help="topic of the camera's poses; default: tf")
    parser.add_argument("--world", default="map", help="tf frame of the map (default map)")
    parser.add_argument("--camera", default="camera_color_optical_frame", help="tf frame of the optical axes")
    parser.add_argument("--camera-info", default="/camera/color/camera_info")
    parser.add_argument("--feed", help="publish poses at tcp://host:port")
    parser.add_argument("--connect", action="store_true", help="to a feed that the scanner binds")
    parser.add_argument("--server", help="send keyframes to this tsfusion server")
    parser.add_argument("--spool", help="folder for keyframes the server does not have yet")
    parser.add_argument("--map", help="the server's map")
    parser.add_argument("--depth", default="/camera/aligned_depth_to_color/image_raw")
    parser.add_argument("--color", help="topic of an image of the depth's size")
    parser.add_argument("--distance", type=float, default=0.1)
    parser.add_argument("--angle", type=float, default=10.0)
    rospy.init_node("tsfusion_bridge")
    bridge = Bridge(parser.parse_args(rospy.myargv()[1:]))
    rospy.spin()
    if bridge.client is not None:
        from tsfusion.core.errors import FlushTimeout

        try:
            bridge.client.flush(timeout=2.0)
        except FlushTimeout as error:
            sys.stderr.write(f"{error}\n")  # ROS's own log has ended
        bridge.client.close()


if __name__ == "__main__":
    main()
