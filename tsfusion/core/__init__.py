# SPDX-License-Identifier: MIT
"""Base of every wing: settings, errors, durable files, locks, processes, logs."""
