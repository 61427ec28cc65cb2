"""`hilsplat run` before Snakemake starts: locks, recovery, options."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from hilsplat.base.artifacts import run_command
from hilsplat.base.errors import HilsplatError, SettingsError
from hilsplat.base.processes import boot_id
from hilsplat.cli.main import app
from hilsplat.workflow import run as runs
from hilsplat.workflow.plan import Plan
from tests.unit.workflow.plans import plan_of, write_sheet

HOLD = """
import sys, time
from pathlib import Path
from hilsplat.workflow.run import mark_run, prepare_process
stream = prepare_process()
if "marked" in sys.argv:
    mark_run(Path("other-results"))
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A project with two scenes."""
    monkeypatch.chdir(tmp_path)
    write_sheet(tmp_path / "config/scenes.tsv")
    Path("config/config.yaml").write_text("variants: {}\n")
    return tmp_path


@pytest.fixture
def started(monkeypatch) -> list[list[str]]:
    """Snakemake command lines that would start."""
    found: list[list[str]] = []

    def start(command: list[str]) -> int:
        found.append(command)
        return 3

    monkeypatch.setattr(runs, "_run", start)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(4)), raising=False)
    return found


@pytest.fixture
def unlocked(monkeypatch) -> list[str]:
    """Calls of `snakemake --unlock`."""
    found: list[str] = []

    def call(words: list[str], **kwargs: object) -> subprocess.CompletedProcess[str]:
        found.extend(word.removeprefix("--") for word in words if word in ("--unlock", "--summary"))
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(runs.subprocess, "run", call)
    return found


def test_init_writes_what_is_missing_beside_the_sheet_of_new_or_after_a_full_disk(folder):
    sheet, config = Path("config/scenes.tsv"), Path("config/config.yaml")
    before = sheet.read_text()
    config.unlink()
    assert runs.start_project(Path()) == [config]
    assert sheet.read_text() == before
    with pytest.raises(HilsplatError, match=r"config\.yaml already exists"):
        runs.start_project(Path())


def value(command: list[str], option: str) -> str:
    return command[command.index(option) + 1]


def test_a_run_takes_the_cores_of_the_machine_and_a_cluster_sets_its_own(folder, started):
    assert runs.run([], [], []) == 3, "Snakemake's exit status"
    runs.run([], [], ["--workflow-profile", "profiles/slurm"])
    here, cluster = started
    assert here[:4] == [sys.executable, "-P", "-m", "snakemake"]
    assert value(here, "--cores") == "4" and "--cores" not in cluster


def test_scenes_become_a_configuration_and_other_targets_stay(folder, started):
    file = "results/synthetic/two/scene"  # similar to the name of a scene
    runs.run(["two", "tables", file], [], ["--config", "seed=1", "--cores=1", "--keep-going"])
    [command] = started
    options = command[command.index("--config") + 1 :]
    assert options[:2] == ["seed=1", 'only=["two"]']
    assert command[-3:] == ["--", "tables", file]
    assert value(command, "--cores") == "1" and "--keep-going" in command
    runs.run(["synthetic/two"], [], [])
    assert 'only=["synthetic/two"]' in started[-1]
    runs.run(["./results/synthetic/two/", "./results/synthetic/two/scene/"], [], [])  # as shells complete
    assert 'only=["synthetic/two"]' in started[-1] and started[-1][-1] == "results/synthetic/two/scene"
    runs.run(["out/synthetic/two/"], [], ["--config", "results=./out/"])
    assert 'only=["synthetic/two"]' in started[-1]
    runs.run(["synthetic/*", "tables"], [], [])
    assert 'only=["synthetic/*"]' in started[-1] and started[-1][-2:] == ["--", "tables"]
    runs.run(["models/the-two"], [], [])  # a file, although it ends like the name of a scene
    assert started[-1][-2:] == ["--", "models/the-two"]


def test_a_misspelt_scene_is_refused(folder, started):
    with pytest.raises(HilsplatError, match="did you mean 'synthetic/two'"):
        runs.run(["twoo"], [], [])
    with pytest.raises(HilsplatError, match=r"no scene, rule or file is named 'photo/\*'"):
        runs.run(["photo/*"], [], [])
    known = "one of all, tables, efficiency, train_models, synthetic/one, synthetic/two\n"
    with pytest.raises(HilsplatError, match=f"no scene, rule or file is named 'desk'(.|\n)*{known}"):
        runs.run(["desk"], [], [])
    assert started == []


def test_outputs_without_their_provenance_that_snakemake_would_keep_are_rebuilt_with_forced_stages(
    folder, started, monkeypatch
):
    ply = Path("results/synthetic/one/gaussians.ply")
    scene = ply.parent / "scene"
    scene.mkdir(parents=True)
    (ply.parent / "default/masks").mkdir(parents=True)  # it is not needed
    ply.write_text("")
    lines = ("output_file\tplan", f"{scene}\tupdate pending", f"{ply}\tno update")
    answer = subprocess.CompletedProcess([], 0, "\n".join(lines), "")
    monkeypatch.setattr(runs.subprocess, "run", lambda words, **kwargs: answer)
    runs.run([str(ply)], [], [])
    runs.run([], [], ["--forcerun", "field"])
    assert started[0][-4:] == ["--forcerun", str(ply), "--", str(ply)]
    assert started[1][-3:] == ["--forcerun", "field", str(ply)]


def test_a_second_run_with_the_same_results_is_refused(folder, started, tmp_path, monkeypatch):
    """It may run in another folder, whose `results` is a link."""
    Path("results").mkdir()
    (tmp_path / "elsewhere").symlink_to(folder / "results")
    lock = runs._locked(tmp_path / "elsewhere/.run.lock")
    with pytest.raises(HilsplatError, match="another hilsplat run"):
        runs.run([], [], [])
    assert runs.run([], [], ["-n"]) == 3, "a dry run needs no lock"
    lock.close()
    assert runs.run([], [], []) == 3


def test_a_signal_reaches_the_workflow_and_its_status_comes_back(folder):
    code = "import os, signal; os.kill(os.getppid(), signal.SIGTERM); signal.pause()"
    assert runs._run([sys.executable, "-c", code]) == 128 + signal.SIGTERM
    assert runs._run([sys.executable, "-c", "raise SystemExit(5)"]) == 5


def test_the_locks_of_a_dead_run_are_removed_once(folder, started, unlocked):
    runs.run([], [], [])
    assert unlocked == [], "no run was killed"
    leave_marker()
    runs.run([], [], [])
    assert unlocked == ["unlock"]
    (runs.STATE / "run-00000002").touch()  # a full disk
    runs.run([], [], [])
    assert unlocked == ["unlock"] * 2 and list(runs.STATE.glob("run-*")) == []


def leave_marker(host: str = "") -> None:
    """Leave the marker of a run that was killed."""
    runs.STATE.mkdir(exist_ok=True)
    (runs.STATE / "run-00000001").write_text(host or socket.gethostname())


@pytest.mark.parametrize("is_marked", [False, True])
def test_the_locks_of_a_live_run_stay(folder, started, unlocked, is_marked):
    """A is killed while B still works. Snakemake would remove B's locks too, so a run beside B is refused
    if B has a marker."""
    leave_marker()
    words = ["marked"] if is_marked else []
    b = subprocess.Popen([sys.executable, "-c", HOLD, *words], stdout=subprocess.PIPE, text=True)
    assert b.stdout.readline() == "held\n"
    if is_marked:
        with pytest.raises(HilsplatError, match="another Snakemake process is running"):
            runs.run([], [], [])
    else:
        runs.run([], [], [])
    assert unlocked == []
    b.kill()
    b.wait()
    runs.run([], [], [])
    assert unlocked == ["unlock"]


def test_the_locks_of_another_machine_stay(folder, started, unlocked, caplog):
    leave_marker("elsewhere")
    runs.run([], [], [])
    assert unlocked == [] and "another machine may be running" in caplog.text
    runs.run([], [], ["--unlock"])
    assert "unlock" in unlocked and list(runs.STATE.glob("run-*")) == []
    unlocked.clear()
    leave_marker(
        f"elsewhere {boot_id()}"
    )  # a container of this machine, which has another name at each start
    runs.run([], [], [])
    assert unlocked == ["unlock"]


def test_options_of_the_command_need_no_separator(folder, started, monkeypatch):
    words = ["run", "two", "-n", "--cores", "1", "--forcerun", "field", "-R", "clip", "--verbose"]
    monkeypatch.setattr(sys, "argv", ["hilsplat", *words])
    assert app(words, standalone_mode=False) == 3
    [command] = started
    assert {"--dry-run", "--verbose"} <= set(command) and value(command, "--cores") == "1"
    assert command[-3:] == ["--forcerun", "field", "clip"]


def test_a_configuration_is_found_by_its_name(folder, project, started):
    Path("config/config.yaml").unlink()
    Path("config/mine.yaml").write_text("seed: 5\n")
    runs.run(["table-1"], [Path("demo"), Path("mine")], ["-n"])  # a scene of the installed sheet
    configs = started[0][started[0].index("--configfile") + 1 :][:2]
    assert configs == [str(project / "config/demo.yaml"), "config/mine.yaml"]
    with pytest.raises(SettingsError, match=r"no configuration is named 'dem'(.|\n)*did you mean 'demo'"):
        runs.run([], [Path("dem")], ["-n"])
    with pytest.raises(SettingsError, match=r"pass keys after --: hilsplat run -- --config seed=3"):
        runs.run([], [Path("seed=3")], ["-n"])
    with pytest.raises(SettingsError, match=r"other\.yaml is missing"):
        runs.run([], [Path("other.yaml")], ["-n"])


def test_a_run_records_installed_configurations_by_name_for_the_commands_of_messages(folder, project):
    Path("config/mine.yaml").write_text("")
    configs = [project / "config/ci.yaml", folder / "config/mine.yaml"]
    runs.record_run(plan_of(folder), configs, {})
    command = "hilsplat run --config ci --config config/mine.yaml results/a/b/scene"
    assert run_command(Path("results/a/b/scene")) == command


def test_messages_suggest_the_options_of_the_last_run_of_a_scene(folder, project):
    runs.record_run(plan_of(folder, only=["two"]), [project / "config/demo.yaml"], {"data_root": "/data"})
    runs.record_run(plan_of(folder, only=["one"]), [], {"seed": 5})
    options, last = "-- --config 'data_root=\"/data\"'", "-- --config seed=5"
    for path in ("synthetic/two/default/masks", "figures/synthetic/two/panel.webp", "synthetic/two"):
        assert run_command(Path("results", path)) == f"hilsplat run --config demo results/{path} {options}"
    for path in ("synthetic/one/scene", "tables/lerf.csv", "figures/sweep-theta.png"):
        assert run_command(Path("results", path)) == f"hilsplat run results/{path} {last}"
    assert run_command(Path("results")) == f"hilsplat run {last}"
    Path("results/synthetic/two/.run.json").unlink()  # a scene of an earlier version of hilsplat
    scene = "results/synthetic/two/scene"
    assert run_command(Path(scene)) == f"hilsplat run {scene} {last}"


def test_values_on_the_command_line_are_read_as_snakemake_reads_them(folder, started, monkeypatch):
    plans: list[Plan] = []
    monkeypatch.setattr(runs, "outdated", lambda plan, **_: plans.append(plan) or {})
    values = ["results=2026-11-30", "masks={levels: tree}", "masks={theta: 0.8}", "masks.min_area_px=5"]
    runs.run([], [], ["-n", "--config", *values])
    masks = plans[0].run.masks
    assert (plans[0].run.results, masks.levels, masks.theta) == ("2026-11-30", "tree", 0.8)
    assert masks.min_area_px == 5 and 'masks={"min_area_px": 5}' in started[0]


def test_a_setting_that_overrides_replace_in_all_scenes_is_refused_or_reported(folder, started, caplog):
    text = "variants: {}\noverrides: {benchmark: {masks: {theta: 0.7}}}\n"
    text += "masks: {points_per_side: 32}\nevaluate: {methods: [tree]}\n"
    Path("config/config.yaml").write_text(text)
    line = r"masks\.theta has no effect, because overrides\.benchmark\.masks\.theta replaces it"
    with pytest.raises(SettingsError, match=line):
        runs.run(["two"], [], ["-n", "--config", "masks.theta=0.8"])
    runs.run([], [], ["-n", "--config", "masks.theta=0.7", "masks.min_area_px=5"])
    runs.run([], [], ["-n", "--config", "overrides.benchmark.masks.theta=0.8"])
    assert len(started) == 2 and not caplog.text
    variant = ["variants={low: {masks: {theta: 0.6}}}", "main_variants=[low]"]
    runs.run([], [], ["-n", "--config", *variant, "masks={theta: 0.7, min_area_px: 5}"])
    (message,) = caplog.messages
    assert message == "--config: masks.theta has no effect on variants that set it: low"
    methods = ["method={name: langsplat, steps: 50}", "overrides={benchmark: {method: {name: lifted}}}"]
    with pytest.raises(SettingsError, match=r"method\.name has no effect"):
        runs.run([], [], ["-n", "--config", *methods])
    Path("config/mine.yaml").write_text("masks: {theta: 0.8, min_area_px: 5}\n")
    runs.run([], [Path("mine")], ["-n"])
    assert re.search(line, caplog.text) and "min_area_px" not in caplog.text
    caplog.clear()
    Path("config/config.yaml").write_text(text.replace("masks: {points", "masks: {theta: 0.6, points"))
    runs.run([], [], ["-n"])
    assert re.search(line, caplog.text)


def test_the_snakefile_is_of_the_checkout_with_the_configuration_or_the_installed_one(
    folder, project, started
):
    for path in (Path("Snakefile"), Path("rules/common.smk")):  # of the user
        path.parent.mkdir(exist_ok=True)
        path.write_text("")
    shutil.copytree(folder, "checkout")
    Path("checkout/rules/semantic_tree.smk").touch()
    runs.run([], [], ["-n"])
    runs.run([], [folder / "checkout/config/config.yaml"], ["-n"])
    found = [value(command, "--snakefile") for command in started]
    assert found == [str(project / "Snakefile"), str(folder / "checkout/Snakefile")]
