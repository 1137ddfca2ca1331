# SPDX-License-Identifier: MIT
"""Install the package for ament, as `colcon build` does."""

from glob import glob

from setuptools import setup

NAME = "tsfusion_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((f"share/{NAME}/{folder}", glob(f"{folder}/*")) for folder in ("launch", "config", "rviz")),
    ],
    install_requires=["setuptools"],
    description="Run tsfusion as a lifecycle node.",
    license="MIT",
    entry_points={"console_scripts": [f"tsfusion_node = {NAME}.tsfusion_node:main"]},
)
