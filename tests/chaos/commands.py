"""Kill user commands while they write: existing files must stay, and the same command must then succeed."""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx2

from hilsplat.annotate.labels import label_path
from tests.bad_inputs.conftest import snapshot
from tests.unit.annotate.label_files import read_labels
from tests.unit.finished_desk import HEIGHT, NUM_VIEWS, WIDTH, build_finished_desk, pack_photographs

COMMANDS = {
    "new": ("new", "chair", "photos.zip"),
    "query": ("query", "photos/desk", "mug", "--out", "answers"),
    "export": ("export", "photos/desk", "--out", "exported"),
}
SIZE = (HEIGHT, WIDTH + NUM_VIEWS)
POLYGON = [[1, 1], [15, 1], [15, 20], [1, 20]]


def prepare(root: Path) -> Path:
    """Return a project with a finished scene and an archive of photographs."""
    project = build_finished_desk(root)
    pack_photographs(project)
    return project


def started(project: Path, *words: str) -> subprocess.Popen[str]:
    """Start a command in a project, in its own session."""
    return subprocess.Popen(
        [sys.executable, "-m", "hilsplat", *words],
        cwd=project,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def kill_command(
    project: Path, name: str, whole_s: float, expected: dict[str, bytes], chance: random.Random
) -> Iterator[str]:
    """Kill a command at a random time, then run it to completion; yield problems that need manual help."""
    before = snapshot(project)
    running = started(project, *COMMANDS[name])
    try:
        running.wait(chance.uniform(0, whole_s))
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
    after = snapshot(project)
    for path, content in after.items():
        if content not in (before.get(path), expected.get(path)):
            yield f"{name}: {path} is neither as before nor whole after a kill"
    if lost := before.keys() - after.keys():
        yield f"{name}: a kill lost {sorted(lost)}"
    if after == expected:  # everything was written before the kill
        return
    again = started(project, *COMMANDS[name])
    said, _ = again.communicate(timeout=600)
    if again.returncode:
        yield f"{name}: the same command failed after a kill:\n{said}"
    elif snapshot(project) != expected:
        found = snapshot(project)
        wrong = [path for path in {*expected, *found} if expected.get(path) != found.get(path)]
        yield f"{name}: after a kill it wrote something else: {sorted(wrong)[:5]}"


def kill_commands(root: Path, kills: int, chance: random.Random) -> list[str]:
    """Kill each command several times, and return problems that need manual intervention."""
    project, problems = prepare(root / "desk"), []
    for name in COMMANDS:
        copy = root / "whole"
        shutil.copytree(project, copy)
        begin = time.monotonic()
        assert started(copy, *COMMANDS[name]).wait(600) == 0
        whole_s, expected = time.monotonic() - begin, snapshot(copy)
        shutil.rmtree(copy)
        for number in range(kills):
            copy = root / f"{name}-{number}"
            shutil.copytree(project, copy)
            problems += kill_command(copy, name, whole_s, expected, chance)
            shutil.rmtree(copy)
        print(f"{kills} kills of {name}, which takes {whole_s:.1f} s", flush=True)
    for number in range(kills):
        copy = root / f"annotate-{number}"
        shutil.copytree(project, copy)
        problems += kill_annotator(copy, chance)
        shutil.rmtree(copy)
    print(f"{kills} kills of annotate", flush=True)
    return problems


def kill_annotator(project: Path, chance: random.Random) -> Iterator[str]:
    """Kill the annotation server while it saves a series of changes.

    Yields:
        Problems that need manual intervention: a confirmed change that is missing, or a damaged file.
    """
    server = started(project, "annotate", "photos/desk", "--no-browser", "--port", "0")
    address = next(word for line in server.stdout for word in line.split() if word.startswith("http://127"))
    confirmed = [-1]
    threading.Thread(target=save_changes, args=(address, confirmed), daemon=True).start()
    time.sleep(chance.uniform(0.2, 3))
    os.killpg(server.pid, signal.SIGKILL)
    server.wait()
    last = confirmed[0]
    path = label_path(project / "annotated/photos/desk", "000.png")
    texts = [label.text for label in read_labels(path)]
    if last >= 0 and texts not in ([f"change {last}"], [f"change {last + 1}"]):
        yield f"annotate: after a kill {path.name} holds {texts}, and change {last} was confirmed"


def save_changes(address: str, confirmed: list[int]) -> None:
    """Replace the annotations of the first photograph until the server has ended."""
    base = address.partition("/?")[0]
    with httpx2.Client(base_url=base, headers={"origin": base, "sec-fetch-site": "same-origin"}) as client:
        client.get(address)
        version = "none"
        while True:
            label = {"id": 1, "level": 1, "text": f"change {confirmed[0] + 1}", "polygons": [POLYGON]}
            try:
                answer = client.put(
                    "/api/labels/0", json={"labels": [label]}, headers={"if-match": f'"{version}"'}
                )
            except httpx2.HTTPError:
                return
            version = answer.json()["version"]
            confirmed[0] += 1
