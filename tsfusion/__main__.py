# SPDX-License-Identifier: MIT
"""`python -m tsfusion` is the `tsfusion` command."""

from tsfusion.cli import main

if __name__ == "__main__":
    main()
