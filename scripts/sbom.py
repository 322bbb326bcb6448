"""Write a CycloneDX bill of materials of the Python packages in each container image.

Usage: python -m scripts.sbom   (or `make sbom`)

The bills have the versions and hashes of the lock files. `make image` checks that the built image
has exactly the packages of its lock file. Packages of Debian are in the bill of
`docker buildx build --sbom=true`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from app import __version__

ROOT = Path(__file__).resolve().parent.parent
BILLS = ROOT / "build"
# Lock files of the two container images. The images contain no development tools.
SHIPPED = {
    "service": ("requirements.lock",),
    "training": ("requirements-training.lock", "requirements-torch.lock"),
}


def bill_of_materials(name: str) -> Path:
    """Write the bill of an image, and return its path.

    Raises:
        subprocess.CalledProcessError: a line of a lock file cannot be read.
    """
    packages, bill = BILLS / f"packages-{name}.txt", BILLS / f"sbom-{name}.cdx.json"
    packages.write_text(
        "".join((ROOT / lock).read_text("utf-8") for lock in SHIPPED[name]), "utf-8"
    )
    subprocess.run(
        [
            *(sys.executable, "-W", "ignore", "-m", "cyclonedx_py", "requirements", packages),
            *("--pyproject=pyproject.toml", "--output-reproducible", "--validate"),
            f"--output-file={bill}",
        ],
        cwd=ROOT,
        check=True,
    )
    content = json.loads(bill.read_text("utf-8"))
    # cyclonedx-py does not find the version, because it is an attribute of `app`.
    content["metadata"]["component"]["version"] = __version__
    bill.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
    return bill


def main() -> None:
    BILLS.mkdir(exist_ok=True)
    for name in SHIPPED:
        bill = bill_of_materials(name)
        components = json.loads(bill.read_text("utf-8"))["components"]
        print(f"{bill.relative_to(ROOT)}: {len(components)} packages")


if __name__ == "__main__":
    main()
