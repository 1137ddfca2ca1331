# SPDX-License-Identifier: MIT
"""Poses that another process publishes over ZeroMQ."""
