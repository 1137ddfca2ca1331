# SPDX-License-Identifier: MIT
"""Localizers: where the sensor is, frame by frame."""
