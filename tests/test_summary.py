"""Laws of what the terminal shows: what differs, best first, within its width."""

from __future__ import annotations

import pytest

from dadiff.running.summary import MOST_ROWS, one_run, several_runs
from dadiff.store import Record, StoredRun
from dadiff.store.names import differences


def run(name: str, cost: float | None, status: str = "finished") -> StoredRun:
    metrics = {} if cost is None else {"cost_ratio": cost, "planned_state_error": 1e-5, "network_calls": 10}
    return StoredRun(
        None, Record("0" * 16, name, status, reason="too short" if cost is None else None, metrics=metrics)
    )


def test_one_run_is_a_short_list_of_what_it_has():
    name, *lines = one_run(run("lqr/known/seed=0", 1.25)).splitlines()
    assert name == "lqr/known/seed=0"
    assert [line.split() for line in lines] == [["state", "error", "1e-05"], ["cost", "ratio", "1.25"], ["calls", "10"]]
    assert one_run(run("lqr/hankel", None, "refused")).splitlines()[1].strip() == "refused: too short"


def test_a_run_in_closed_loop_says_what_its_episodes_cost():
    metrics = {
        "cost_ratio": 1.0,
        "plan_latency_p99": 0.02,
        "closed_loop_receding_10": 1.3,
        "closed_loop_same_receding_10": 1,
    }
    lines = one_run(StoredRun(None, Record("0" * 16, "lqr", "finished", metrics=metrics))).splitlines()
    assert lines[-1].split() == ["receding,", "planning", "every", "10", "1.3"]
    assert len(lines) == 4


def test_several_runs_are_ranked_and_called_by_what_differs():
    runs = [
        run("lqr/none/mlp/seed=0", 1.5),
        run("lqr/hankel/mlp/seed=0", None, "refused"),
        run("lqr/known/mlp/seed=0", 1.1),
    ]
    head, *rows = several_runs(runs).splitlines()
    assert head.split()[0] == "run"
    assert [row.split()[0] for row in rows] == ["known", "none", "hankel"]
    assert rows[2].split()[1] == "refused"
    many = [run(f"lqr/seed={seed}", float(seed)) for seed in range(MOST_ROWS + 5)]
    assert several_runs(many).splitlines()[-1] == "... and 5 more"
    assert several_runs([]) == ""


@pytest.mark.parametrize("width", [60, 80, 200])
def test_the_table_fits_the_terminal(width, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    runs = [run(f"lqr/{'long' * 20}_{kind}/seed=0", 1.0) for kind in ("known", "none")]
    assert max(map(len, several_runs(runs).splitlines())) <= width
    assert "known" in several_runs(runs)


def test_a_narrow_terminal_shows_fewer_numbers_and_whole_words(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    runs = [run(f"lqr/{kind}/dpm_solver(num_steps=5)/seed=0", 1.0) for kind in ("hankel_lowrank", "none")]
    head, first, *_ = several_runs(runs).splitlines()
    assert head.split() == ["run", "cost", "ratio", "state", "error"]
    assert first.startswith("hankel_lowrank")


def test_names_keep_at_least_one_word():
    assert differences(["lqr/known/seed=0", "lqr/known/seed=1"]) == ["seed=0", "seed=1"]
    assert differences(["lqr/known"]) == ["lqr/known"]
