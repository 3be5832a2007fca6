"""Laws of launching: no job harms another, each way to die has its reason, what waits holds no worker."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from dadiff.errors import ConfigError, DataError, WorkerError
from dadiff.launching.outcome import Outcome, why
from dadiff.launching.process_pool import ProcessPool
from dadiff.launching.table import Table, clock, last_line, progress_of, shortened, time_left
from dadiff.launching.work import Running, Work
from dadiff.threads import cores


def write(path: Path, text: str, seconds: float = 0.0) -> None:
    time.sleep(seconds)
    with path.open("a") as stream:
        stream.write(text + "\n")


def write_after(other: str, path: Path, text: str) -> None:
    """Ends only if the other is written by somebody else meanwhile."""
    while not path.exists() or other not in path.read_text():
        time.sleep(0.01)
    write(path, text)


def fail(kind: str) -> None:
    os.write(1, b"about to fail\n")
    if kind == "error":
        raise DataError("states.npz: row 3 is nan")
    if kind == "bug":
        raise ZeroDivisionError("division by zero")
    if kind == "memory":
        raise MemoryError
    if kind == "exit":
        os._exit(7)
    if kind == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    time.sleep(60)


def multiply(path: Path) -> None:
    """Multiplies in every thread that torch has: would hang if the server had threads when it forked."""
    import torch

    size = float((torch.ones(400, 400) @ torch.ones(400, 400)).sum())
    path.write_text(f"{size:.0f} {torch.get_num_threads()} {os.environ['OMP_NUM_THREADS']}")


def threads_and_times() -> None:
    import torch

    begun = time.time()
    time.sleep(0.3)
    os.write(1, f"{torch.get_num_threads()} {begun} {time.time()}".encode())


def meeting(own: Path, other: Path) -> None:
    import torch

    own.touch()
    while not other.exists():
        time.sleep(0.01)
    os.write(1, str(torch.get_num_threads()).encode())


class Silent:
    def ended(self, work, outcome) -> None:
        pass

    def tick(self, running) -> None:
        pass


def work(root: Path, key: str, function, *arguments, needs=()) -> Work:
    return Work(key, key, function, arguments, root / "logs" / f"{key}.log", frozenset(needs))


@pytest.fixture(scope="module")
def pool():
    return ProcessPool(workers=4, preload=["torch"])


def test_every_way_to_end_has_its_status_and_reason_and_harms_no_other(pool, tmp_path):
    kinds = ["error", "bug", "memory", "exit", "kill", "crash"]
    works = [work(tmp_path, kind, fail, kind) for kind in kinds]
    works += [work(tmp_path, f"fine{i}", write, tmp_path / "out", "x") for i in range(3)]
    outcomes = pool.run(works, Silent())
    expected = {
        "error": ("failed", "states.npz: row 3 is nan"),
        "bug": ("failed", "ZeroDivisionError: division by zero"),
        "memory": ("out_of_memory", "out of memory"),
        "exit": ("failed", "exited with code 7"),
        "kill": ("killed", "killed by SIGKILL, perhaps because memory ran out"),
        "crash": ("killed", "killed by SIGSEGV"),
    }
    for kind, (status, reason) in expected.items():
        assert outcomes[kind].status == status
        assert reason in outcomes[kind].reason
        assert str(tmp_path / "logs" / f"{kind}.log") in outcomes[kind].reason
        assert "about to fail" in (tmp_path / "logs" / f"{kind}.log").read_text()
    assert "Traceback" in (tmp_path / "logs" / "bug.log").read_text()
    assert (tmp_path / "out").read_text() == "x\n" * 3


def test_a_job_that_takes_too_long_is_ended(pool, tmp_path):
    works = [work(tmp_path, "sleep", fail, "sleep")]
    outcomes = ProcessPool(workers=1, time_limit=0.5).run(works, Silent())
    assert outcomes["sleep"].status == "timeout"
    assert "time limit of 0.5 s" in outcomes["sleep"].reason


def test_work_waits_for_what_it_needs_without_holding_a_worker(tmp_path):
    out = tmp_path / "out"
    works = [work(tmp_path, f"cell{i}", write, out, f"cell{i}", needs=["train"]) for i in range(3)]
    works += [work(tmp_path, "train", write_after, "free", out, "train"), work(tmp_path, "free", write, out, "free")]
    outcomes = ProcessPool(workers=2, time_limit=60.0).run(works, Silent())
    assert out.read_text().split()[:2] == ["free", "train"]
    assert {outcome.status for outcome in outcomes.values()} == {"finished"}


def test_what_needs_a_failure_is_given_up_with_its_reason(pool, tmp_path):
    works = [
        work(tmp_path, "train", fail, "error"),
        work(tmp_path, "cell", write, tmp_path / "out", "x", needs=["train"]),
        work(tmp_path, "after", write, tmp_path / "out", "x", needs=["cell"]),
    ]
    outcomes = pool.run(works, Silent())
    assert outcomes["cell"].status == "failed"
    assert "needs train, which failed: states.npz: row 3 is nan" in outcomes["cell"].reason
    assert outcomes["after"].status == "failed"
    assert not (tmp_path / "out").exists()


def test_threads_are_limited_and_work_after_the_fork(tmp_path):
    outcomes = ProcessPool(workers=1).run([work(tmp_path, "a", multiply, tmp_path / "a")], Silent())
    assert outcomes["a"].reason is None
    assert (tmp_path / "a").read_text() == "64000000 1 1"


def test_a_module_in_the_current_folder_is_not_imported_for_one_of_its_name(tmp_path):
    (tmp_path / "textwrap.py").write_text("raise SystemExit('imported from the current folder')")
    script = tmp_path / "bin" / "go.py"
    script.parent.mkdir()
    script.write_text(
        "from pathlib import Path\n"
        "from dadiff.launching.process_pool import ProcessPool\n"
        "from test_launching import Silent, work, write\n"
        "works = [work(Path.cwd(), 'a', write, Path('out'), 'done')]\n"
        "if __name__ == '__main__':\n"
        "    ProcessPool(workers=1, preload=['textwrap']).run(works, Silent())\n"
    )
    path = os.pathsep.join([str(Path(__file__).parents[1]), str(Path(__file__).parent)])
    subprocess.run(
        [sys.executable, script], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, check=True, timeout=60
    )
    assert (tmp_path / "out").read_text() == "done\n"


def test_an_interrupt_ends_the_jobs(pool, tmp_path):
    class Impatient(Silent):
        def tick(self, running) -> None:
            self.running = list(running)
            raise KeyboardInterrupt

    observer = Impatient()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        pool.run([work(tmp_path, "a", fail, "sleep")], observer)
    assert time.monotonic() - start < 10
    assert observer.running[0].process.exitcode == -signal.SIGTERM


@pytest.mark.parametrize("bad", [{"workers": 0}, {"workers": 1, "threads": -1}, {"workers": 1, "time_limit": 0.0}])
def test_numbers_that_make_no_sense_are_refused(bad):
    with pytest.raises(ConfigError, match="must be positive"):
        ProcessPool(**bad)


@pytest.mark.parametrize("threads", [1, 2, 10_000])
@pytest.mark.parametrize("workers", [None, 1, 2])
def test_workers_and_threads_do_not_exceed_the_cores(workers, threads):
    crowd = ProcessPool(workers, threads=threads)
    assert crowd.workers == (workers or max(1, cores() // threads))
    assert crowd.workers * crowd.threads <= max(cores(), crowd.workers)


def test_an_endless_reason_is_cut_and_hangs_nothing(pool, tmp_path):
    outcome = pool.run([work(tmp_path, "long", fail_at_length)], Silent())["long"]
    assert outcome.status == "failed"
    assert len(outcome.reason) < 3000


def fail_at_length() -> None:
    raise ValueError("x" * 200_000)


def test_reasons_tell_memory_from_other_failures():
    assert why(RuntimeError("DefaultCPUAllocator: can't allocate memory: 5 TB"))[0] == "out_of_memory"
    assert why(DataError("a\n b")) == ("failed", "a b")
    assert why(KeyboardInterrupt())[0] == "interrupted"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()])
def test_the_table_shows_what_runs_and_keeps_what_ended(stream, pool, tmp_path, monkeypatch):
    monkeypatch.setattr("dadiff.launching.table.REDRAW_SECONDS", 0.0)
    works = [work(tmp_path, "a", write, tmp_path / "o", "x", 0.6), work(tmp_path, "b", fail, "error")]
    table = Table(stream, works, skipped=3)
    pool.run(works, table)
    table.close()
    shown = stream.getvalue()
    assert "[2/2]" in shown
    assert "row 3 is nan" in shown
    assert ("1 running" in shown) == stream.isatty()
    assert ("\x1b[" in shown) == stream.isatty()


def test_a_live_row_keeps_what_differs_and_the_progress_at_80_columns(tmp_path, monkeypatch):
    monkeypatch.setattr("dadiff.launching.table.REDRAW_SECONDS", 0.0)
    monkeypatch.setenv("COLUMNS", "80")
    names = {
        key: f"lqr/{kind}/S=100/w=0.01/normalised/{'mlp' * 20}/seed=0"
        for key, kind in zip("ab", ("known", "none"), strict=True)
    }
    works = [replace(work(tmp_path, key, write), name=name) for key, name in names.items()]
    works[0].log_file.parent.mkdir(parents=True, exist_ok=True)
    works[0].log_file.write_text("sampling:  42%|####      | 42/100 [00:05<00:07,  8.2it/s]")
    stream = Terminal()
    table = Table(stream, works, skipped=0)
    table.ended(works[1], Outcome("finished", None, 60.0))
    table.tick([Running(works[0])])
    *_, summary, row = stream.getvalue().splitlines()
    assert row.split(maxsplit=2)[2] == "known  sampling 42 %, 00:07 left"
    assert "1 done, 1 running" in summary
    assert summary.endswith("about 1:00 left") or summary.endswith("about 60.0 s left")
    assert max(map(len, stream.getvalue().splitlines())) < 80


def test_the_time_left_is_that_of_what_runs_and_waits_at_the_pace_of_what_ended():
    assert time_left([], [1.0], 5) is None
    assert time_left([10.0, 30.0], [5.0, 5.0], waiting=4) == (15 + 15 + 4 * 20) / 2
    assert shortened("a" * 30 + "b" * 30, 21) == "a" * 10 + "…" + "b" * 10
    assert progress_of("2026-01-31 12:00:00,123 loading the data") == "loading the data"


def test_the_last_line_of_a_log_is_its_progress(tmp_path):
    log = tmp_path / "log"
    assert last_line(log) == ""
    log.write_text("start\nsampling:  10%|#\rsampling:  42%|####  \x1b[A")
    assert last_line(log).startswith("sampling:  42%|####")
    assert [clock(s) for s in (7.31, 245, 7800)] == ["7.3 s", "4:05", "2:10:00"]


def test_a_training_waits_for_the_rest_and_has_every_thread(tmp_path):
    crowd = [work(tmp_path, key, threads_and_times) for key in "ab"]
    alone = replace(work(tmp_path, "c", threads_and_times), trains=True)
    after = [work(tmp_path, key, threads_and_times) for key in "de"]
    ProcessPool(workers=2, threads=1, preload=["torch"]).run([*crowd, alone, *after], Silent())
    seen = {key: (tmp_path / "logs" / f"{key}.log").read_text().split() for key in "abcde"}
    assert {key: int(words[0]) for key, words in seen.items()} == {"a": 1, "b": 1, "c": 2, "d": 1, "e": 1}
    begun, ended = ({key: float(words[k]) for key, words in seen.items()} for k in (1, 2))
    assert max(ended["a"], ended["b"]) <= begun["c"]
    assert ended["c"] <= min(begun["d"], begun["e"])


def test_trainings_with_a_thread_each_run_side_by_side(tmp_path):
    """Each ends only once the other has begun."""
    both = [
        replace(work(tmp_path, one, meeting), trains=True, arguments=(tmp_path / one, tmp_path / other))
        for one, other in ("ab", "ba")
    ]
    ends = ProcessPool(2, time_limit=120, preload=["torch"], training_threads=1).run(both, Silent())
    assert [end.status for end in ends.values()] == ["finished", "finished"]
    assert [(tmp_path / "logs" / f"{key}.log").read_text() for key in "ab"] == ["1", "1"]


def test_a_server_that_was_killed_is_told_in_a_line(tmp_path, monkeypatch):
    pool = ProcessPool(1)
    for error in (EOFError("unexpected EOF"), ConnectionRefusedError(111, "Connection refused"), BrokenPipeError()):
        monkeypatch.setattr(pool._context.Process, "start", lambda self, error=error: (_ for _ in ()).throw(error))
        with pytest.raises(WorkerError, match=r"^launcher: the server that jobs are forked from has died .*goes on"):
            pool.run([], Silent())
