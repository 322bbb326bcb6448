"""The generators of ROS 2 read the interfaces of the node, and compilers read their output."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.client import callers
from tests.client.ros_messages import OWN
from tests.conftest import FindTool, run_program
from tests.deploy.ros import STORE

pytestmark = pytest.mark.system

FILES = sorted(OWN.glob("*/*.*"))
# Messages of ROS that the own ones use.
USED = (
    "builtin_interfaces/msg/Time",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Vector3",
    "std_msgs/msg/Header",
)
HEADERS = [path for kind in ("rcutils", "rosidl_*") for path in Path("/usr/include").glob(kind)]
ANSWER: dict[str, Any] = {
    "success": True,
    "message": "",
    "header": {"stamp": {"sec": 12, "nanosec": 5}, "frame_id": "map"},
    "places": [
        {
            "room": "bathroom",
            "relation": "inside",
            "object": "t4",
            "probability": 0.6,
            "is_listed": False,
            "position": {"x": 1.0, "y": 2.0, "z": 0.5},
            "position_std": {"x": 0.1, "y": 0.2, "z": 0.3},
        }
    ],
    "rooms": [{"room": "bathroom", "probability": 0.7}, {"room": "kitchen", "probability": 0.1}],
    "not_here": 0.2,
}


@pytest.fixture(scope="module")
def generated(find_tool: FindTool, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the generated C and C++, one folder for each package."""
    program, folder = find_tool("rosidl"), tmp_path_factory.mktemp("rosidl")
    find_tool("/usr/libexec/rosidl/rosidl_generator_cpp")
    sources = {OWN.name: [(OWN, str(path.relative_to(OWN))) for path in FILES]}
    for name in USED:
        package, rest = name.split("/", 1)
        path = folder / "messages" / package / f"{rest}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        text, _ = STORE.generate_msgdef(name, ros_version=2)
        path.write_text(text.split("=" * 80)[0])
        sources.setdefault(package, []).append((folder / "messages" / package, f"{rest}.msg"))
    for package, files in sources.items():
        # An empty search path for packages of Python, and the folder of Debian for those of ROS.
        environment = {"PATH": os.environ["PATH"], "AMENT_PREFIX_PATH": "/usr"}
        run_program(
            *(program, "generate", "--output-path", folder / package, "--type", "c", "--type"),
            *("cpp", package, *(f"{root}:{file}" for root, file in files)),
            cwd=folder,
            env=environment,
        )
        # Includes begin with the name of the package.
        for language in ("c", "cpp"):
            (folder / language).mkdir(exist_ok=True)
            (folder / package / language).rename(folder / language / package)
    return folder


def test_every_file_is_built() -> None:
    listed = re.findall(r'^  "(.+)"$', (OWN / "CMakeLists.txt").read_text("utf-8"), re.MULTILINE)
    assert listed == [str(path.relative_to(OWN)) for path in FILES]
    for path in FILES:
        lines = path.read_text("ascii").splitlines()  # the generators read no other letters
        assert lines[0].startswith("# ")
        for line in lines:
            if line.startswith("float64"):
                assert "#" in line, f"{path.name}: state the unit or the range: {line}"


def test_c_and_cpp_are_generated(generated: Path) -> None:
    for path in FILES:
        name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", path.stem).lower()
        folder = path.parent.name
        assert (generated / f"c/{OWN.name}/{folder}/detail/{name}__functions.c").is_file()
        assert (generated / f"cpp/{OWN.name}/{folder}/{name}.hpp").is_file()


def test_the_generated_c_compiles(find_tool: FindTool, generated: Path) -> None:
    folder = generated / "c" / OWN.name
    sources = sorted(folder.glob("*/detail/*__functions.c"))
    assert len(sources) == len(FILES)
    run_program(
        *(find_tool("gcc"), "-fsyntax-only", "-Wall", "-Werror", f"-I{generated / 'c'}"),
        *(f"-I{path}" for path in HEADERS),
        *sources,
    )


def test_a_response_holds_an_answer(find_tool, generated, tmp_path):
    """The generated C++ of WhereIs holds each field of an answer."""
    program = callers.compiled(
        find_tool,
        Path(__file__).parent / "where_is.cpp",
        tmp_path / "where_is",
        generated / "cpp",
        *HEADERS,
    )
    printed = run_program(program, input=json.dumps(ANSWER)).stdout
    assert yaml.safe_load(printed) == ANSWER
