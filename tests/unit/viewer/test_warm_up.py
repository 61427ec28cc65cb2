"""All loops are compiled before the page opens."""

import os
import subprocess
import sys

from tests.conftest import PROJECT
from tests.unit.finished_desk import SCENE

USED = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from hilsplat.viewer import exports
from hilsplat.viewer.frames import painted, pick
from hilsplat.viewer.viewer_scene import ViewerScene

def loops():
    modules = [module for name, module in sys.modules.items() if name.startswith("hilsplat")]
    found = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {(loop.__name__, types) for loop in found for types in loop.signatures}

shown = ViewerScene(Path(sys.argv[1]))
shown.warm_up()
before = loops()
scene, camera = shown.answering("default"), shown.scene.cameras["001.png"]
painted(shown.gaussians, camera, None, 1)
pick(shown.gaussians, scene.tree.node_of_gaussian, camera, 4, 4, 1)
scene.select("mug", view="001.png")
scene.select("mug", answerer="field")
scene.node_masks("001.png", [0])
exports.crop(scene, 0)
print(len(before), sorted(name for name, _ in loops() - before))
"""


def test_every_loop_is_compiled_by_the_warm_up(built_desk):
    run = subprocess.run(
        [sys.executable, "-c", USED, str(built_desk / SCENE)],
        cwd=built_desk,
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        capture_output=True,
        text=True,
        check=False,
    )
    ready, _, later = run.stdout.strip().partition(" ")
    assert run.returncode == 0 and int(ready) >= 3 and later == "[]", run.stdout + run.stderr
