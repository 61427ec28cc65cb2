"""`make bench`: timings of all benchmark modules in one table, printed and written as Markdown and JSON.

The column "room" is the name of a module `test_<room>.py`. A case records in `benchmark.extra_info`:
    case: its name, such as "forward, 100k 800x600, D=3, 1 thread";
    count, of: number and kind of items that one call handles, for the rate (optional);
    flop: useful floating-point operations of one call, for the share of the peak rate (optional);
    peak_mib: peak memory beyond that in use before the call (optional).
The second table contains the list GOALS of each module (see `goals.Goal`).
"""

import datetime
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.machine import fma_peak_gflops
from benchmarks.table import markdown_table
from hilsplat.base.processes import keep_freed_memory

keep_freed_memory()  # as all commands do

HEAD = ("room", "case", "least ms", "median ms", "rounds", "rate", "share of FMA peak", "peak MiB")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option --out FOLDER."""
    parser.addoption("--out", type=Path, default=Path("results/benchmarks"), help="folder of the tables")


def _cases(session: Any, peak_gflops: float) -> list[dict[str, Any]]:
    """Return one record per timed case."""
    out = []
    for bench in session.benchmarks:
        if bench.has_error or not bench.stats.data:
            continue
        info, least = bench.extra_info, bench.stats.min
        record = {
            "room": Path(bench.fullname.split("::")[0]).stem.removeprefix("test_"),
            "case": info["case"],
            "least_ms": 1e3 * least,
            "median_ms": 1e3 * bench.stats.median,
            "rounds": bench.stats.rounds,
        }
        if "count" in info:
            record |= {"rate_per_s": info["count"] / least, "of": info["of"]}
        if "flop" in info:
            record["share_of_peak"] = info["flop"] / least / (1e9 * peak_gflops * info.get("threads", 1))
        if "peak_mib" in info:
            record["peak_mib"] = info["peak_mib"]
        out.append(record)
    return out


def _row(case: dict[str, Any]) -> tuple[str, ...]:
    rate = f"{case['rate_per_s']:.3g} {case['of']}/s" if "rate_per_s" in case else ""
    share = f"{100 * case['share_of_peak']:.1f} %" if "share_of_peak" in case else ""
    peak = f"{case['peak_mib']:.0f}" if "peak_mib" in case else ""
    times = (f"{case['least_ms']:.2f}", f"{case['median_ms']:.2f}", str(case["rounds"]))
    return case["room"], case["case"], *times, rate, share, peak


def _machine(peak_gflops: float) -> dict[str, Any]:
    """Return the machine and versions that the figures depend on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    load = os.getloadavg()[0]
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "processor": f"{model}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "numba": sys.modules["numba"].__version__,
        "fma_peak_gflops_one_core": round(peak_gflops, 1),
        "load_at_the_end": round(load, 1),
    }


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print and write the tables."""
    session = getattr(config, "_benchmarksession", None)
    if session is None or not session.benchmarks:
        return
    peak_gflops = fma_peak_gflops()
    machine, cases = _machine(peak_gflops), _cases(session, peak_gflops)
    times = {case["case"]: case["least_ms"] for case in cases}
    times |= {f"{case['case']}, peak MiB": case["peak_mib"] for case in cases if "peak_mib" in case}
    goals = [row for goal in config.stash.get(GOALS, []) if (row := goal.row(times))]
    text = "\n\n".join(
        [
            ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in machine.items()),
            markdown_table(HEAD, [_row(case) for case in cases]),
            *([markdown_table(("goal", "found", "wanted", "met"), goals)] if goals else []),
        ]
    )
    terminalreporter.write_line(f"\n{text}\n")
    out = config.getoption("--out")
    out.mkdir(parents=True, exist_ok=True)
    content = {"machine": machine, "cases": cases, "goals": [list(goal) for goal in goals]}
    for name, data in (("benchmarks.md", text), ("benchmarks.json", json.dumps(content, indent=1))):
        temporary = out / f".{name}.{os.getpid()}"
        temporary.write_text(data + "\n", encoding="utf-8")
        temporary.replace(out / name)
    terminalreporter.write_line(f"written to {out}/benchmarks.md and benchmarks.json")


GOALS: pytest.StashKey[list] = pytest.StashKey()


def pytest_collection_modifyitems(config: pytest.Config, items: list[Any]) -> None:
    """Collect the goals of the selected modules."""
    modules = dict.fromkeys(item.module for item in items)
    config.stash[GOALS] = [goal for module in modules for goal in getattr(module, "GOALS", [])]
