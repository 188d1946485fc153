"""The soak notices what it is for: growth, hangs, tracebacks, robots outside; its report is resumed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest

from mqe_jax.errors import InputError
from tests.soak import play, processes
from tests.soak.__main__ import Options, Report
from tests.soak.processes import Outcome, Sample
from tests.states import initial, made, placed


def test_a_report_is_resumed_and_repeats_only_rows_that_were_cut_off(tmp_path: Path) -> None:
    report = Report(tmp_path, Options(engine="c"), minutes=1.0)
    report.begin(1)
    report.add("play", "a", {"steps": 1200}, [])
    report.add("play", "b", {"steps": 7, "partial": True}, ["outside in 3 steps"])
    again = Report(tmp_path, Options(engine="c"), minutes=1.0)
    again.begin(2)
    assert 25.0 < again.seconds_left() <= 30.0
    assert list(again.pending("play", ["a", "b", "c"])) == ["b", "c"]
    assert again.wrong() == ["play b: outside in 3 steps"]
    text = (tmp_path / "soak.md").read_text()
    assert "- play b: outside in 3 steps" in text and "| a | 1,200 |" in text
    late = Report(tmp_path, Options(), minutes=0.0)
    late.begin(1)
    assert list(late.pending("play", ["c"])) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["soak.json", "soak.md"]


def test_rows_of_fewer_steps_are_repeated_and_those_of_another_engine_are_not_continued(tmp_path: Path) -> None:
    Report(tmp_path, Options(engine="c"), minutes=1.0).add("play", "a", {"steps": 1200}, [])
    more = Report(tmp_path, Options(engine="c"), minutes=1.0)
    assert [list(more.pending("play", ["a"], steps)) for steps in (1000, 1200, 1201)] == [[], [], ["a"]]
    with pytest.raises(InputError, match=r"soak\.json: has rows of the engine c; name another --folder"):
        Report(tmp_path, Options(engine="warp"), minutes=1.0)


@pytest.mark.parametrize(("grown", "files", "wrong"), [(1.02, 20, 0), (1.2, 20, 1), (1.0, 40, 1)])
def test_memory_and_descriptors_may_not_grow_after_the_warm_up(grown: float, files: int, wrong: int) -> None:
    rows = [Sample(2.0 * i, int(5e8 * min(1.0, 0.5 + i / 60)), 20, 9) for i in range(300)]
    rows += [Sample(600.0 + 2.0 * i, int(5e8 * grown), files, 9) for i in range(60)]
    row, found = processes.judged(rows, [])
    assert row["minutes"] == 12.0 and row["descriptors_late"] == files
    assert len(found) == wrong


def test_a_robot_behind_a_wall_or_below_the_ground_is_outside() -> None:
    env: Any = made("go1gate")
    half = env.compiled.scene.track.width / 2
    places = {(1.0, 0.0, 0.3): False, (1.0, half + 0.3, 0.3): True, (-0.5, 0.0, 0.3): True, (1.0, 0.0, -1.0): True}
    for place, out in places.items():
        state = placed(env, [[1.0, 0.5, 0.3], place], state=initial(env))
        assert bool(play.outside(env, state.data)) == out, place
    nowhere = initial(env).data.replace(qpos=jnp.full_like(initial(env).data.qpos, jnp.nan))
    assert bool(play.outside(env, nowhere))


PROGRAM = """
import json, sys, time
from pathlib import Path
from tests.soak import processes as c
c.SECONDS, c.WAITING, c.BYTES = 0.5, 8.0, 3 * 10**8
def hangs(): time.sleep(60)
def computes():
    while time.process_time() < 0.7: pass  # of this process
    return 2
def grows(): return len([b"x" * (10**7 + i) for i in range(100)] + [time.sleep(60)])
def fails(): raise KeyError("x")
def leaves(): Path(".a.1.tmp").touch(); return 2
def refuses(): print("mqe: a: 1 is not allowed", file=sys.stderr); return 2
print(json.dumps([vars(c.contained(act)) for act in (hangs, computes, grows, fails, leaves, refuses)]))
"""


def test_a_contained_program_that_hangs_grows_fails_or_leaves_files_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, cwd=root)
    assert done.returncode == 0, done.stderr
    hangs, computes, grows, fails, leaves, refuses = (Outcome(**fields) for fields in json.loads(done.stdout))
    monkeypatch.setattr(processes, "SECONDS", 0.5)
    assert hangs.code is None and 4.0 < hangs.seconds < 12.0 and hangs.computing < 0.5
    assert computes.code == 2 and "computing" in computes.failures(2)[0]
    assert grows.code is None and grows.memory > 3 * 10**8 and grows.failures(2)
    assert "a traceback" in fails.failures(1)
    assert leaves.failures(2) == ["left .a.1.tmp"]
    assert refuses.failures(2) == [] and refuses.failures(0) != []
