# SPDX-License-Identifier: MIT
"""Messages between scanner, server and viewers: keyframe codec, control messages, sockets and keys."""
