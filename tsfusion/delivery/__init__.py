# SPDX-License-Identifier: MIT
"""The sending side inside the client: spool, outbox, backpressure.

Everything is kept, and sent again, until the server has it on its disk.
"""
