# SPDX-License-Identifier: MIT
"""Send records (keyframes and corrections) from a client to its server: spool, outbox and backpressure.

Every record is kept, and sent again if needed, until the server has it on its disk.
"""
