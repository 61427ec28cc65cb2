"""Libraries that starting a stage imports."""

import subprocess
import sys

from hilsplat.workflow.stages import STAGES

TRAINING = {"models"}  # stages whose losses are torch's


def test_only_stages_that_train_import_torch():
    modules = sorted({place.partition(":")[0] for stage, place in STAGES.items() if stage not in TRAINING})
    code = f"import sys, {', '.join(modules)}; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"
