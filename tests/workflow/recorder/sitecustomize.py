"""Imported by the processes of a recorded run; notes which modules and data of our packages they load."""

import atexit
import json
import os
import sys
from pathlib import Path

PACKAGES = ("cpusplat", "hilsplat", "hilsplat_world")
opened: set[str] = set()


def note(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and isinstance(arguments[0], str):
        opened.add(arguments[0])


def write() -> None:
    root = os.environ["PYTHONPATH"].partition(os.pathsep)[0]
    paths = {os.path.relpath(path, root) for path in opened if path.startswith("/")}
    data = [path for path in paths if path.partition("/")[0] in PACKAGES and "__pycache__" not in path]
    # A package counts only if it is imported itself (`base.code`); most of ours are empty.
    loaded = {name for name, module in sys.modules.items() if not hasattr(module, "__path__")}
    modules = [name for name in loaded if name.partition(".")[0] in PACKAGES]
    found = {"words": sys.argv[1:], "modules": modules, "data": data}
    Path(os.environ["RECORDED"], f"{os.getpid()}.json").write_text(json.dumps(found))


if "RECORDED" in os.environ:
    sys.addaudithook(note)
    atexit.register(write)
