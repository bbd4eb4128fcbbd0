"""Build by colcon. The client, `mapless`, is installed by pip: rosdep does not know it."""

from setuptools import setup

NAME = "mapless_ros"

setup(
    name=NAME,
    version="0.4.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/mapless.launch.py"]),
        (f"share/{NAME}/config", ["config/mapless.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="mapless",
    maintainer_email="mapless@users.noreply.github.com",
    description="Visual localization of a robot by a mapless server",
    license="Apache-2.0",
    entry_points={"console_scripts": ["mapless_node = mapless_ros.node:main"]},
)
