"""One run at a time in a project's folder, and Ctrl-C that is never lost."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from gyro_pipeline.conventions import InputError
from gyro_pipeline.hooks import _version
from gyro_pipeline.run_lock import Interrupts, check_folder, only_run

HOLDS = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from gyro_pipeline.run_lock import only_run
with only_run(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(float(sys.argv[2]))
"""


def holder(path, seconds):
    command = [sys.executable, "-c", HOLDS, str(path), str(seconds)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


@pytest.mark.slow
def test_a_second_run_says_who_is_first_waits_and_goes_on(tmp_path, caplog):
    path = tmp_path / "data" / "run.lock"
    first = holder(path, 1)
    began = time.monotonic()
    with caplog.at_level("INFO"), only_run(path):
        assert first.wait(10) == 0
        assert time.monotonic() - began > 0.3
    said = caplog.text
    assert f"another run works in {path.parent}, process {first.pid} on " in said
    assert "waiting until it ends (Ctrl-C ends the wait)" in said
    assert "this run continues" in said
    caplog.clear()
    with only_run(path):  # nobody holds it
        assert caplog.text == ""


@pytest.mark.slow
def test_the_lock_of_a_killed_run_is_none_and_ctrl_c_ends_a_wait(tmp_path):
    path = tmp_path / "run.lock"
    first = holder(path, 60)
    waiting = subprocess.Popen([sys.executable, "-c", HOLDS, str(path), "0"], stderr=-1)
    while b"waiting until it ends" not in waiting.stderr.readline():
        pass
    waiting.send_signal(signal.SIGINT)
    assert waiting.wait(10) != 0
    first.kill()
    first.wait()
    with only_run(path):
        pass


def test_an_interrupt_that_python_could_not_raise_ends_the_run_at_the_next_result():
    class Finaliser:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)

    interrupts = Interrupts()
    with pytest.raises(KeyboardInterrupt), interrupts.watch():
        interrupts.after_dataset_saved()
        del_me = Finaliser()
        del del_me  # "Exception ignored in"
        interrupts.after_dataset_saved()
    with pytest.raises(KeyboardInterrupt), Interrupts().watch():
        del_me = Finaliser()
        del del_me
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_leaves_no_thread_that_python_would_wait_for(monkeypatch):
    start = ThreadPoolExecutor._adjust_thread_count

    def interrupted(pool):
        os.kill(os.getpid(), signal.SIGINT)
        start(pool)

    monkeypatch.setattr(ThreadPoolExecutor, "_adjust_thread_count", interrupted)
    interrupts = Interrupts()
    with ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt), interrupts.watch():
        assert pool.submit(int).result() == 0
        interrupts.after_dataset_saved()


def test_a_folder_that_others_would_misread_is_refused(tmp_path):
    check_folder(tmp_path / "blanks and 'quotes' and ü")
    for name in ("a?b", "%41", "a{1}", 'say "no"'):
        with pytest.raises(InputError, match="move the project to a folder whose path has no such"):
            check_folder(tmp_path / name)


def test_the_version_is_the_projects_own_or_unknown(tmp_path):
    def git(*arguments):
        return subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True)

    unknown = {"mlflow.source.git.commit": "unknown", "git_dirty": "unknown"}
    assert _version(tmp_path) == unknown
    git("init", "-q")
    assert _version(tmp_path) == unknown  # without a commit
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    git(*identity, "commit", "-q", "--allow-empty", "-m", "first")
    assert _version(tmp_path)["git_dirty"] == "False"
    (tmp_path / "unpacked").mkdir()
    assert _version(tmp_path / "unpacked") == unknown  # of another project
    (tmp_path / "new").touch()
    assert _version(tmp_path)["git_dirty"] == "True"
