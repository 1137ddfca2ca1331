# SPDX-License-Identifier: MIT
"""What travels between scanner, server and viewers: the keyframe codec, control messages, and the sockets and
keys they travel with.
"""
