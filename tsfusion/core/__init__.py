# SPDX-License-Identifier: MIT
"""What every wing stands on: settings, errors, durable files, locks, processes, logs."""
