"""What colcon builds and installs of the node's package."""

from glob import glob

from setuptools import setup

NAME = "quest_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*.yaml")),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The QueST authors",
    maintainer_email="maintainers@example.com",
    description="A node that tracks handles, knobs, rims and fronts in the pictures of a camera, with QueST",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"track = {NAME}.node:main"]},
)
