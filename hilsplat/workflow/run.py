"""`hilsplat run`: Snakemake with checks, and with options that users would otherwise type.

It recovers from a killed run, rebuilds artifacts that don't match their provenance, and starts Snakemake.
Plain `snakemake --cores 2` produces the same bytes.
"""

import argparse
import json
import logging
import os
import re
import secrets
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import yaml

from hilsplat.base.artifacts import RUN, read_memo, write_json, write_text
from hilsplat.base.errors import HilsplatError, SettingsError, nearest
from hilsplat.base.files import INSTALLED, project_path
from hilsplat.base.processes import (
    boot_id,
    end_with_workflow,
    lock,
    num_cores,
    parent_variable,
    remove_leftovers,
)
from hilsplat.base.removal import delete
from hilsplat.configuration import CONFIG, SECTIONS, first_unusable, merged_config, parse_run, read_config
from hilsplat.scene.sheet import DEFAULT_SHEET, SceneRow, is_pattern, matches_of, read_sheet, with_installed
from hilsplat.workflow.estimate import forecasts
from hilsplat.workflow.plan import Plan, kept_by_variants, without_effect
from hilsplat.workflow.records import outdated
from hilsplat.workflow.summary import summary

logger = logging.getLogger(__name__)

STATE = Path(".hilsplat")  # folder in the working folder for locks and markers
MARKER = "run-[0-9a-f]{8}"  # name of the file in it that marks a run

UNREGISTERED = "HILSPLAT_UNREGISTERED"
"""Environment variable that makes a Snakemake process skip our lock, as `snakemake --unlock` must."""

TARGET_RULES = ("all", "tables", "efficiency", "train_models")
"""Rules that can be targets; all others have wildcards."""

ELSEWHERE = ("--executor", "-e", "--profile", "--workflow-profile")
"""Snakemake options that may set cores and threads; if one is given, they are not set here."""


_held: list[TextIOWrapper] = []  # the lock on the results and the marker of this process's run, if any


def prepare_process() -> TextIOWrapper | None:
    """Prepare a process that reads the Snakefile, and return a lock to keep (None in a read-only folder).

    Jobs use the interpreter that runs Snakemake, whether or not its environment is activated, and end with
    Snakemake. The lock is shared and is taken before Snakemake's own locks, which record no owner. If no
    process holds our lock, Snakemake's locks are left over from a dead run.
    """
    end_with_workflow()  # `hilsplat run` may have started this process
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    os.environ |= parent_variable()
    if os.environ.get(UNREGISTERED):
        return None
    with suppress(OSError):
        return _locked(STATE / "processes.lock", shared=True)
    return None


def mark_run(results: Path) -> None:
    """Lock the results, which several folders may share, and a marker; a killed run leaves it unlocked.

    Raises:
        HilsplatError: another run writes to these results.
    """
    _held.append(_locked_results(results))
    marker = _locked(STATE / f"run-{secrets.token_hex(4)}")
    marker.write(f"{socket.gethostname()} {boot_id()}")
    marker.flush()
    _held.append(marker)


def record_run(plan: Plan, configs: Sequence[Path], overrides: Mapping[str, Any]) -> None:
    """Record a run's options in its results and scenes, for the commands in messages (`run_command`)."""
    files = [_config_name(Path(path)) for path in configs]
    values = [f"{key}={json.dumps(value)}" for key, value in overrides.items() if key != "only"]
    run = {"results": [str(plan.results)], "config": files, "overrides": values}
    write_json(plan.results / RUN, run)
    for row in plan.scenes:
        record, path = {"scene": [row.name], **run}, Path(plan.path(row), RUN)
        if read_memo(path, dict[str, list[str]]) != record:  # few of a thousand scenes change
            write_json(path, record)


def _config_name(path: Path) -> str:
    """Return the name of a configuration for `--config`: that of an installed one, or a relative path."""
    beside = CONFIG.with_name(path.name)
    is_installed = not beside.exists() and path.resolve() == (INSTALLED / beside).resolve()
    return path.stem if is_installed else os.path.relpath(path)


def unmark_run() -> None:
    """Remove the marker of this process's run, and unlock the results."""
    while _held:
        stream = _held.pop()
        if re.fullmatch(MARKER, Path(stream.name).name):
            delete(Path(stream.name), MARKER)
        stream.close()


def _locked_results(results: Path) -> TextIOWrapper:
    """Lock a results folder until the returned file is closed; HilsplatError if another run holds it."""
    try:
        return _locked(results / ".run.lock", wait=False)
    except BlockingIOError as error:
        fix = "let it finish, or stop it"
        raise HilsplatError(f"another hilsplat run has locked {results}", fix=fix) from error


def _locked(path: Path, *, shared: bool = False, wait: bool = True) -> TextIOWrapper:
    path.parent.mkdir(parents=True, exist_ok=True)
    stream = path.open("a+", encoding="utf-8")  # NFS 4 refuses a shared lock on a file that is not readable
    try:
        lock(stream, shared=shared, wait=wait)
    except OSError:
        stream.close()
        raise
    return stream


def start_project(folder: Path) -> list[Path]:
    """Copy the default configuration and scene sheet into a folder, without replacing an existing one."""
    missing = [path for path in (CONFIG, DEFAULT_SHEET) if not os.path.lexists(folder / path)]
    if not missing:
        raise HilsplatError(f"{folder / CONFIG} already exists", fix="edit it, or choose another folder")
    for path in missing:
        write_text(folder / path, (INSTALLED / path).read_text(encoding="utf-8"))
    return [folder / path for path in missing]


def run(
    targets: Sequence[str], configs: Sequence[Path], options: Sequence[str], *, every_byte: bool = False
) -> int:
    """Run the workflow in the working folder, and return Snakemake's exit status.

    Args:
        targets: scenes (`desk`, `photos/*`) or their folders, rules (`tables`) or files; empty: everything.
        configs: files that override config/config.yaml, in order.
        options: passed to Snakemake unchanged.
        every_byte: read all results of earlier runs, and rebuild those that are damaged.

    Raises:
        HilsplatError: another run writes to these results, or the configuration is invalid.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config", "-C", nargs="*", action="extend", default=[])
    parser.add_argument("--configfile", "--configfiles", nargs="+", action="extend", type=Path, default=[])
    parser.add_argument("--cores", "-c")
    parser.add_argument("--forcerun", "-R", nargs="*", action="extend", default=[])
    given, others = parser.parse_known_args(list(options))
    if _has(others, "--directory", "-d"):  # results of this folder would be checked, locked and described
        fix = "change to that folder first (cd), or pass --config results=FOLDER"
        raise HilsplatError("hilsplat run works in the current folder; --directory is refused", fix=fix)
    configs = [_config_file(path) for path in (*configs, *given.configfile)]
    given.config = [_nested(word) for word in given.config]
    try:  # as Snakemake does: values are strings, and mappings of one key are merged
        words = [word.partition("=") for word in given.config]
        overrides = [{key: yaml.load(value, yaml.BaseLoader)} for key, _, value in words]
    except yaml.YAMLError as error:
        raise SettingsError(
            f"--config is not valid YAML: {error}", expected="key=value", found=" ".join(given.config)
        ) from error
    settings = merged_config(configs, *overrides)
    try:
        chosen = parse_run(settings)
    except SettingsError as error:
        error.add_line("in", first_unusable(configs))
        raise
    rows = read_sheet(project_path(chosen.scenes), (), chosen.data_root)  # the plan checks the folders
    rows = with_installed(rows, chosen.only, chosen.data_root)
    files, names = f"{chosen.results}/", {row.name for row in rows}
    targets = [str(Path(target)) for target in targets]  # shells complete folders with a slash
    targets = [name if (name := target.removeprefix(files)) in names else target for target in targets]
    scenes = [target for target, rows_of_target in matches_of(rows, targets).items() if rows_of_target]
    named = [each for each in targets if each not in scenes and not each.startswith(files)]
    _require_known(named, rows, chosen.results)
    if scenes:
        given.config.append(f"only={json.dumps(scenes)}")
        settings["only"] = scenes
    plan = Plan(settings)
    for layer in (_edited(), *map(read_config, configs)):
        for line in without_effect(plan, layer):
            logger.warning("%s", line)
    for layer in overrides:
        for line in without_effect(plan, layer):
            raise SettingsError(f"--config: {line}", fix="set the other key instead")
        for line in kept_by_variants(plan, layer):
            logger.warning("--config: %s", line)
    command = ["snakemake", "--snakefile", str(_snakefile(configs)), *others]
    command += ["--configfile", *map(str, configs)] if configs else []
    command += ["--config", *given.config] if given.config else []
    if given.cores or not _has(others, *ELSEWHERE, "--jobs", "-j"):
        command += ["--cores", given.cores or str(num_cores())]
    for folder in (Path.cwd(), Path(".snakemake")):
        if folder.exists() and not os.access(folder, os.W_OK):
            fix = "run in a folder of your own: hilsplat init there, or copy config/ to it"
            raise HilsplatError(f"{folder} cannot be written, but Snakemake keeps its state there", fix=fix)
    if _has(others, "-n", "--dry-run", "--dryrun"):
        return _start(command, plan, targets, scenes, given.forcerun, every_byte)
    with _locked_results(plan.results):
        _recover(command, plan.results)
    if not _has(others, *ELSEWHERE):
        cores = int(given.cores) if given.cores and given.cores.isdecimal() else 0
        for line in forecasts(plan, cores or num_cores()):
            logger.info("%s", line)
    status = _start(command, plan, targets, scenes, given.forcerun, every_byte)
    if status != 0:
        with suppress(HilsplatError), _locked_results(plan.results):
            remove_leftovers(plan.results)  # left by killed jobs
        return status
    for line in summary(plan, [target for target in targets if target.startswith(files)]):
        logger.info("%s", line)
    return 0


def _edited() -> dict[str, dict[str, Any]]:
    """Return the settings of the project's config.yaml that differ from the installed one."""
    own, installed = read_config(project_path(CONFIG)), read_config(INSTALLED / CONFIG)
    return {
        section: {key: new for key, new in values.items() if installed.get(section, {}).get(key) != new}
        for section, values in own.items()
        if section in SECTIONS and values
    }


def _nested(word: str) -> str:
    """Return `gaussians={"iterations": 300}` for `gaussians.iterations=300`; other words are unchanged."""
    key, equals, value = word.partition("=")
    first, *names = key.split(".")
    for name in reversed(names):
        value = f"{{{json.dumps(name)}: {value}}}"
    return first + equals + value if equals else word


def _config_file(name: Path) -> Path:
    """Return the path of a configuration file; `ci` means `config/ci.yaml`, here or in the installation."""
    named = CONFIG.with_name(f"{name.name}.yaml")
    if "=" in str(name) and not name.exists():
        command = f"hilsplat run -- --config {shlex.quote(str(name))}"
        raise SettingsError(f"{name} is not a file", fix=f"pass keys after --: {command}")
    if name.suffix or len(name.parts) != 1 or name.exists():
        return project_path(name)
    if not (file := project_path(named)).exists():
        known = {
            path.stem for folder in (Path(), INSTALLED) for path in (folder / named).parent.glob("*.yaml")
        }
        raise SettingsError(
            f"no configuration is named {str(name)!r}", expected=nearest(str(name), sorted(known))
        )
    return file


def _require_known(targets: Sequence[str], rows: Sequence[SceneRow], results: str) -> None:
    """Refuse a target that is neither a scene nor a rule and cannot be a results file."""
    known = [*TARGET_RULES, *(row.name for row in rows)]
    names = [*known, *(row.scene for row in rows)]
    for target in targets:
        may_be_file = "/" in target and not (is_pattern(target) or get_close_matches(target, names))
        if target not in TARGET_RULES and not may_be_file:
            raise HilsplatError(
                f"no scene, rule or file is named {target!r}",
                expected=nearest(target, known),
                fix=f"correct the name; files are in {results}/; for photographs: hilsplat new NAME FOLDER",
            )


def _start(
    command: list[str],
    plan: Plan,
    targets: Sequence[str],
    scenes: Sequence[str],
    forced: Sequence[str],
    every_byte: bool,
) -> int:
    """Start Snakemake, and rebuild `forced` artifacts and those that don't match their provenance."""
    files = [target for target in targets if target not in scenes]
    ending = ["--", *files] if files else []
    wrong = outdated(plan, every_byte=every_byte)
    if wrong:
        lines = _snakemake(command, "--summary", *ending).stdout.splitlines()
        unchanged = {line.split("\t")[0] for line in lines if line.endswith("\tno update")}
        wrong = {output: reason for output, reason in wrong.items() if output in unchanged}
    for output, reason in wrong.items():
        logger.warning("rebuilding %s: %s", output, reason)
    rebuilt = ["--forcerun", *forced, *wrong] if forced or wrong else []
    return _run([sys.executable, "-P", "-m", *command, *rebuilt, *ending])


def _run(command: Sequence[str]) -> int:
    """Run a command that ends with this process, pass signals on to it, and return its exit status."""
    child = subprocess.Popen(command, env=os.environ | parent_variable())
    forwarded = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    is_interactive = sys.stdin is not None and sys.stdin.isatty()  # then, Ctrl-C reaches both processes
    handlers = {
        number: signal.signal(number, lambda received, _: child.send_signal(received))
        for number in (*forwarded, signal.SIGINT)
    }
    if is_interactive:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        status = child.wait()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return status if status >= 0 else 128 - status


def _snakemake(command: Sequence[str], *words: str) -> subprocess.CompletedProcess[str]:
    """Run a Snakemake command that starts no jobs and takes no lock in this folder."""
    environment = {**os.environ, UNREGISTERED: "1"}
    command = [sys.executable, "-P", "-m", *command, *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def _snakefile(configs: Sequence[Path]) -> Path:
    """Return the Snakefile of the checkout that has the configuration, otherwise the installed one.

    A user's own Snakefile may be next to the configuration, too, but not next to our rules.
    """
    beside = [
        folder for path in (CONFIG, *configs) if path.is_file() for folder in path.resolve().parents[:2]
    ]
    ours = (folder for folder in beside if (folder / "rules/semantic_tree.smk").is_file())
    return next(ours, INSTALLED) / "Snakefile"


def _has(words: Sequence[str], *options: str) -> bool:
    """Return whether words contain an option, including the forms `--option=value` and `-o8`."""
    return any(
        word.split("=")[0] == option or (len(option) == 2 and word.startswith(option))
        for word in words
        for option in options
    )


def _recover(command: Sequence[str], results: Path) -> None:
    """Remove unfinished files left by a killed run and, if no process is alive, Snakemake's locks."""
    markers = sorted(STATE.glob("run-*"))
    if not markers:
        return
    for marker in markers:
        try:
            _locked(marker, wait=False).close()
        except BlockingIOError as error:  # at its end, this run would remove the other run's locks
            raise HilsplatError(
                f"another Snakemake process is running in {Path.cwd()}", fix="let it finish, or stop it"
            ) from error
    remove_leftovers(results)
    hosts = [marker.read_text(encoding="utf-8").split() for marker in markers]  # none if its disk was full
    here = {socket.gethostname(), boot_id()} - {""}
    if any(host and here.isdisjoint(host) for host in hosts) and "--unlock" not in command:
        logger.warning("another machine may be running this workflow; if not, add once: -- --unlock")
        return
    try:
        alone = _locked(STATE / "processes.lock", wait=False)
    except BlockingIOError:
        logger.warning("jobs of a killed run are still running: wait for them, or end them (scancel)")
        return
    with alone:
        done = _snakemake(command, "--unlock")
        if done.returncode != 0:
            raise HilsplatError(
                "the locks of a killed run cannot be removed", found=done.stderr.strip()[-500:]
            )
        for marker in markers:
            delete(marker, MARKER)
