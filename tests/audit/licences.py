"""Lists what the service runs on, with versions and licences, as installed: `make audit`."""

import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution

_NAME = re.compile(r"[A-Za-z0-9._-]+")


def closure(root: str) -> dict[str, Distribution]:
    """All that `root` needs to run, directly or not, without extras."""
    found: dict[str, Distribution] = {}
    waiting = [root]
    while waiting:
        name = waiting.pop()
        try:
            package = distribution(name)
        except PackageNotFoundError:  # of another platform
            continue
        if package.name not in found:
            found[package.name] = package
            needed = [text for text in package.requires or () if "extra ==" not in text]
            waiting += [match.group() for text in needed if (match := _NAME.match(text))]
    return found


def licence(package: Distribution) -> str:
    """What it says of itself, in one line."""
    said = package.metadata
    classified = [
        text.rpartition(" :: ")[2]
        for text in said.get_all("Classifier") or ()
        if text.startswith("License ::")
    ]
    text = said.get("License-Expression") or ", ".join(classified) or said.get("License") or ""
    return text.strip().splitlines()[0][:60] if text.strip() else "(not stated)"


def main() -> int:
    unknown = 0
    for name, package in sorted(closure("gpom").items(), key=lambda item: item[0].lower()):
        text = licence(package)
        unknown += text == "(not stated)"
        sys.stdout.write(f"{name:28}{package.version:14}{text}\n")
    return min(unknown, 1)


if __name__ == "__main__":
    sys.exit(main())
