from setuptools import setup

NAME = "scene_reasoning"

setup(
    name=NAME,
    version="2.0.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/scene.launch.py"]),
        (f"share/{NAME}/config", ["config/scene.yaml"]),
    ],
    install_requires=["setuptools", "scene-client"],
    zip_safe=True,
    description="What a moving robot knows about a home",
    entry_points={"console_scripts": [f"scene = {NAME}.node:main"]},
)
