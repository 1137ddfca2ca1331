# SPDX-License-Identifier: MIT
"""A ROS 1 node that tells poses, tf, calibration and images of a camera, lap after lap.

It runs under the system's Python, where rospy is; it needs nothing else. In each of the first eleven tenths
of every second second the camera goes along x by 0.2 m, and turns about z by 0.1 rad.
"""

import itertools
import math
import struct
import sys

import rospy
import tf2_ros
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image

START = 1_700_000_000
WIDTH, HEIGHT = 8, 6

rospy.init_node("talker")
poses = rospy.Publisher("/pose", PoseStamped, queue_size=100)
odometry = rospy.Publisher("/odometry", Odometry, queue_size=100)
calibration = rospy.Publisher("/info", CameraInfo, queue_size=100)
depths = rospy.Publisher("/depth", Image, queue_size=100)
colors = rospy.Publisher("/color", Image, queue_size=100)
transforms = tf2_ros.TransformBroadcaster()


def image(stamp: rospy.Time, encoding: str, pixel: bytes) -> Image:
    message = Image(height=HEIGHT, width=WIDTH, encoding=encoding, step=WIDTH * len(pixel) + 2)
    message.header.stamp = stamp
    message.data = (pixel * WIDTH + b"\0\0") * HEIGHT  # rows may be padded
    return message


for lap in itertools.takewhile(lambda _: not rospy.is_shutdown(), itertools.count()):
    for tenth in range(11):
        stamp = rospy.Time(START + 2 * lap + tenth // 10, tenth % 10 * 100_000_000)
        pose = PoseStamped()
        pose.header.stamp = stamp
        pose.pose.position.x = 0.2 * tenth
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(0.05 * tenth), math.cos(0.05 * tenth)
        moved = Odometry(header=pose.header)
        moved.pose.pose = pose.pose
        transform = TransformStamped()
        transform.header.stamp, transform.header.frame_id, transform.child_frame_id = stamp, "odom", "camera"
        transform.transform.translation.x = pose.pose.position.x
        transform.transform.rotation = pose.pose.orientation
        info = CameraInfo(width=WIDTH, height=HEIGHT, K=[10.0, 0, 3.5, 0, 10.0, 2.5, 0, 0, 1])
        info.header.stamp = stamp
        if "poses" in sys.argv:
            poses.publish(pose)
            odometry.publish(moved)
        if "tf" in sys.argv:
            transforms.sendTransform(transform)
        calibration.publish(info)
        colors.publish(image(stamp, "rgb8", bytes((200, 100, 50))))
        depths.publish(image(stamp, "16UC1", struct.pack("<H", 1500 + tenth)))
        rospy.sleep(0.01)
