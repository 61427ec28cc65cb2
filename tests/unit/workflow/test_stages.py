"""Libraries that starting a stage imports."""

import subprocess
import sys

from hilsplat.workflow.stages import STAGES


def test_starting_a_stage_does_not_import_torch():
    modules = sorted({place.partition(":")[0] for place in STAGES.values()})
    code = f"import sys, {', '.join(modules)}; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"
