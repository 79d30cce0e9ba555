"""What a person types and sees."""

import json
import os
import signal
import subprocess
import sys
import termios
import threading
import time
from contextlib import suppress
from unittest.mock import Mock

import numpy as np
import pytest
from click.testing import CliRunner

from gyro_pipeline.calibrator.cli import main
from gyro_pipeline.calibrator.stream import Parser
from gyro_pipeline.parameters import ReaderOptions

RATE = 100
BIAS = np.array([0.412, -0.104, 0.087])


def rates(seconds, seed=1):
    noise = np.array([5.2, 4.7, 6.0]) * 1e-3 * np.sqrt(RATE)
    return BIAS + np.random.default_rng(seed).normal(0, noise, (seconds * RATE, 3))


def text(samples, header="time (s),gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s)"):
    rows = np.column_stack([np.arange(len(samples)) / RATE, samples])
    return "\n".join([header, *(",".join(f"{x:.9g}" for x in row) for row in rows), ""])


@pytest.fixture(autouse=True)
def registry(tmp_path, monkeypatch):
    monkeypatch.setenv("GYRO_CALIBRATE_REGISTRY", str(tmp_path / "registry"))


@pytest.fixture
def csv(tmp_path):
    def write(samples, name="still.csv", **options):
        path = tmp_path / name
        path.write_text(text(samples, **options))
        return str(path)

    return write


def run(*arguments, **options):
    return CliRunner().invoke(main, [str(a) for a in arguments], **options)


def said(*arguments, **options):
    result = run(*arguments, "--json", **options)
    return json.loads(result.stdout.splitlines()[-1]), result


def test_a_log_needs_no_configuration(csv):
    result = run("log", csv(rates(20)))
    assert result.exit_code == 0
    first, _, x, y, z, *_ = result.stdout.splitlines()
    assert first == "at rest for 20.0 of 20.0 s; history: none"
    for row, bias in zip((x, y, z), BIAS, strict=True):
        assert float(row.split()[1]) == pytest.approx(bias, abs=5e-3)


def test_a_log_that_is_too_short_is_not_taken_for_a_stored_value(csv):
    result = run("log", csv(rates(1)[:60]), "--type", "memsense")
    assert (result.exit_code, "Too short" in result.stdout) == (4, True)
    assert "stored value" not in result.stdout


@pytest.mark.slow
def test_six_logs_make_a_history_that_the_next_one_uses_but_not_the_same_one(csv):
    about = ("--device", "B17", "--type", "memsense", "--same-heading")
    paths = [csv(rates(20, seed), f"{seed}.csv") for seed in range(6)]
    assert run("log", *paths, *about).exit_code == 0
    alone, _ = said("log", csv(rates(5, 99)), "--type", "memsense")
    with_history, _ = said("log", csv(rates(5, 99)), *about, "--no-store")
    assert with_history["history"] == ["used"] * 3
    for now, before in zip(with_history["sigma_dps"], alone["sigma_dps"], strict=True):
        assert now < 0.7 * before
    assert "B17" in run("devices", "list").stdout
    shown = run("devices", "show", "B17").stdout
    assert "5.csv" in shown
    assert "tau" in shown
    run("log", paths[0], "--device", "B18", "--type", "memsense")
    again, result = said("log", paths[0], "--device", "B18")
    assert again["history"] == ["none"] * 3
    assert "stored already" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ([], 0, ""),
        (["--target", "0.1"], 3, ""),
        (["--require-history"], 5, ""),
        (["--units", "rad/s", "--trust", "options"], 6, "a wrong unit?"),
        (["--type", "nope"], 2, "expected consumer, dot, memsense"),
        (["--units", "m"], 2, "--units: "),
        (["--columns", "a,b,c"], 2, "expected one column 'a', got 0"),
        (["--target", "0"], 2, "target: expected more than 0 mdps"),
        (["--target", "nan"], 2, "got nan"),
    ],
)
def test_exit_codes_of_a_log(csv, arguments, code, words):
    result = run("log", csv(rates(20)), "--type", "memsense", *arguments)
    assert (result.exit_code, words in result.stderr) == (code, True)


def test_what_is_lacking_is_named_as_an_option(csv, tmp_path):
    np.save(tmp_path / "still.npy", rates(20))
    log, units = ("log", tmp_path / "still.npy"), ("--units", "deg/s")
    for options, lacking in (((), "give --units"), (units, "give --rate")):
        result = run(*log, *options)
        assert (result.exit_code, lacking in result.stderr) == (2, True)
    assert run(*log, *units, "--rate", RATE).exit_code == 0
    # a file that is refused does not stop the others, and the highest code counts
    result = run(*log, csv(rates(20)), *units, "--type", "memsense", "--target", "0.1")
    assert (result.exit_code, "give --rate" in result.stderr) == (3, True)
    assert "at rest for 20.0 of 20.0 s" in result.stdout


def test_each_log_has_an_answer_and_advice_can_be_typed(csv, tmp_path):
    (tmp_path / "empty.csv").write_text("")
    np.save(tmp_path / "still.npy", rates(20))
    paths = csv(rates(20)), "empty.csv", tmp_path / "still.npy", "missing.csv"
    answers = [json.loads(line) for line in run("log", *paths, "--json").stdout.splitlines()]
    assert len({frozenset(answer) for answer in answers}) == 1  # the same keys
    assert [answer["rest"] for answer in answers] == ["still", None, None, None]
    bare = csv(rates(20), "bare.csv", header="")
    wrong_unit = csv(rates(20) * 1000, "mdps.csv")
    given = ("--columns", "1,2,3", "--units", "deg/s", "--rate", "0")
    for arguments, code, words in (
        (("missing.csv",), 2, "missing.csv: cannot be read"),
        ((bare,), 2, "give --columns, such as gx,gy,gz, and --units"),
        ((bare, *given), 2, "--rate: expected at least 2 samples"),
        ((wrong_unit,), 6, "check --units and --scale"),
        ((bare, "--units", "raw"), 2, "raw and --scale go together"),
        ((bare, wrong_unit, "--started-at", "2026-01-31"), 2, "--started-at: expected one log"),
    ):
        result = run("log", *arguments)
        assert (result.exit_code, words in result.stderr) == (code, True)
    assert "such as sensor=1" in " ".join(run("log", "--help").stdout.split())
    for timeout in ("-1", "nan"):
        assert "--timeout: expected" in run("stream", "--timeout", timeout).stderr


def test_a_registry_that_cannot_be_written_is_said_before_measuring(csv, tmp_path):
    (tmp_path / "file").write_text("")
    about = ("log", csv(rates(20)), "--device", "B17", "--registry", tmp_path / "file")
    result = run(*about)
    assert (result.exit_code, result.stdout) == (7, "")
    assert run(*about, "--no-store").exit_code == 0


def test_plan_says_how_long_or_that_it_is_not_possible():
    seconds = (5.2 / (1 / 3.6)) ** 2
    result = run("plan", "--heading", "1deg/h", "--type", "memsense")
    assert float(result.stdout.split()[1]) == pytest.approx(seconds, rel=0.01)
    result = run("plan", "--target", "1", "--type", "dot")
    assert (result.exit_code, "not with this sensor: its floor is" in result.stdout) == (3, True)
    answer, _ = said("plan", "--target", "1", "--type", "dot")
    assert answer["seconds"][0] is None
    assert "its floor is" in answer["reasons"][0]["sentence"]
    assert "give --type" in run("plan", "--target", "1").stderr


def test_a_bias_that_was_typed_in_stays_until_it_is_forgotten(csv):
    zero, lacking = ("0.5", "-0.1", "0.09", "--sigma", "0"), ("0.5", "-0.1", "0.09")
    bad = {("nan", *zero[1:4], "1"): "expected three rates", zero: "sigma above 0"}
    for arguments, words in {**bad, lacking: "--sigma"}.items():
        result = run("devices", "set", "B17", *arguments)
        assert (result.exit_code, words in result.stderr) == (2, True)
    typed = ("0.5", "-0.1", "0.09", "--sigma", "0.4", "--type", "memsense")
    assert run("devices", "set", "B17", *typed).exit_code == 0
    for seed in range(2):
        run("log", csv(rates(20, seed), f"{seed}.csv"), "--device", "B17", "--same-heading")
    answer, _ = said("log", csv(rates(2)), "--device", "B17", "--same-heading", "--no-store")
    assert answer["history"][0] == "dropped"  # x was typed in wrong
    assert "set by hand" in run("log", csv(rates(2)), "--device", "B17", "--no-store").stdout
    run("devices", "set", "B18", *typed[:5])  # one block of unknown noise has no bound, but JSON
    answer, _ = said("log", csv(rates(1)[:60]), "--device", "B18")
    assert [None] * 3 != answer["bias_dps"]
    run("devices", "forget", "B17", "set")
    answer, _ = said("log", csv(rates(2)), "--device", "B17", "--same-heading", "--no-store")
    assert answer["history"] == ["used"] * 3


def test_attempts_are_counted_until_one_does_and_the_highest_code_counts(csv, tmp_path):
    moving = csv(rates(20) + 20 * np.sin(np.arange(2000) / 30)[:, None], "moving.csv")
    once, _ = said("log", csv(rates(20)), "--no-store")
    assert run("log", moving, csv(rates(20)), "--device", "B17").exit_code == 4
    lines = (tmp_path / "registry/B17/calibrations.jsonl").read_text().splitlines()
    stored = [json.loads(line) for line in lines]
    assert [(one["rest"], one["attempt"]) for one in stored] == [("moving", 1), ("still", 2)]
    again, _ = said("log", csv(rates(20)), "--device", "B17", "--no-store")
    third, _ = said("log", csv(rates(20, 3)), "--device", "B17", "--no-store")
    attempted = ["attempt" in {reason["code"] for reason in r["reasons"]} for r in (again, third)]
    assert attempted == [True, False]
    assert again["sigma_dps"][0] > 1.1 * once["sigma_dps"][0]  # Bonferroni's limit of two


def test_notes_and_withdrawals_are_appended(csv, tmp_path):
    run("log", csv(rates(20)), "--device", "B17", "--type", "memsense")
    assert run("devices", "note", "B17", "in a new case").exit_code == 0
    before, _ = said("log", csv(rates(2)), "--device", "B17", "--no-store")
    assert run("devices", "note", "B17", "fell", "--knocked").exit_code == 0
    knocked, _ = said("log", csv(rates(2)), "--device", "B17", "--no-store")
    told = ["knocked" in {reason["code"] for reason in r["reasons"]} for r in (before, knocked)]
    assert told == [False, True]
    assert "note of a knock: fell" in run("devices", "show", "B17").stdout
    for start in ("", "no.csv"):
        assert "forget: expected one of still.csv" in run("devices", "forget", "B17", start).stderr
    assert run("devices", "forget", "B17", "still.csv").exit_code == 0
    assert "does not count" in run("devices", "show", "B17").stdout
    assert run("devices", "save", "B17", tmp_path / "b17.json").exit_code == 0
    assert run("devices", "load", tmp_path / "b17.json", "--as", "B18").exit_code == 0
    assert json.loads(run("devices", "list", "--json").stdout)[1]["device"] == "B18"
    noted, _ = said("devices", "note", "B18", "back")
    assert noted == {"device": "B18", "noted": "back"}
    assert "not read or written" in run("devices", "save", "B17", tmp_path / "no/b.json").stderr
    # one device that cannot be read is said, and the others are listed
    for part, text in (("model.json", "[1]"), ("device.toml", "type =")):
        (tmp_path / "registry/B18" / part).write_text(text)
    result = run("devices", "show", "B18")
    assert (result.exit_code, "model.json: expected figures" in result.stderr) == (2, True)
    result = run("devices", "list")
    assert (result.exit_code, "device.toml: expected TOML" in result.stderr) == (2, True)
    assert result.stdout.startswith("B17")
    assert run("devices", "forget", "B17", "--all").exit_code == 0
    assert run("devices", "show", "B17").exit_code == 2


def streamed(*arguments, send, close=True):
    """What is sent through a pipe, whose other end then closes or stays open."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)  # all of it has to fit into the pipe
    with os.fdopen(reading, "rb") as source, os.fdopen(writing, "wb", 0) as sink:
        assert sink.write(send.encode()) == len(send)
        if close:
            sink.close()
        return run("stream", "--type", "memsense", *arguments, input=source)


def test_a_stream_ends_when_the_target_is_reached():
    done = streamed("--target", "2", "--json", send=text(rates(11)))
    first, *_, last = map(json.loads, done.stdout.splitlines())
    assert done.exit_code == 0
    assert (first["bias_dps"], first["seconds_left"]) == ([None] * 3, [7.0, 6.0, 9.5])
    assert 8 <= last["seconds_at_rest"] <= 10  # 6.0^2 / 2^2 = 9 s


def test_the_rate_of_a_stream_is_that_of_stamps_of_whole_milliseconds():
    """400 Hz: the stamps alternate between steps of 2 and 3 ms; one of 60 samples is lost."""
    rows = [f"{n * 5 // 2},{n % 7},{n % 5},{n % 3}" for n in range(2000) if n % 60 != 10]
    header = "time (ms),gyro_x (mdps),gyro_y (mdps),gyro_z (mdps)"
    done = streamed("--known-still", "--json", send="\n".join([header, *rows]))
    last = json.loads(done.stdout.splitlines()[-1])
    assert 4.4 < last["seconds_at_rest"] <= 5
    assert "the times show 100" in streamed("--rate", "50", send=text(rates(5))).stderr


def test_a_stream_with_bursts_comments_or_no_header_is_read_as_a_file():
    """The rate is that of all times, also where ten samples or two rows come with one stamp."""
    values, number = rates(20), np.arange(2000)
    header, *rows = text(values).splitlines()
    cells = [row.split(",", 1)[1] for row in rows]
    bursts = [f"{n // 10 / 10 + n % 10 * 8.5e-5:.6f},{cells[n]}" for n in number]
    twice = [f"{n // 2 / 50 + n % 2 * 1.4e-5:.6f},{cells[n // 2]}" for n in number]
    positions = ("--columns", "1,2,3", "--units", "deg/s", "--time-column", "0", "--time-units")
    for lines, options in (
        ([header, *bursts], ()),
        ([header, *twice], ()),
        (["# begun at noon", f"# {header}", *rows[:50], "# all is well", *rows[50:]], ()),
        (["0.04,0.1", *rows], (*positions, "s")),
    ):
        send = "\n".join(lines[:1200])  # what fits into a pipe
        last = json.loads(streamed("--json", *options, send=send).stdout.splitlines()[-1])
        assert 11.4 < last["seconds_at_rest"] <= 12
        assert last["sigma_dps"][0] == pytest.approx(5.2e-3 / 12**0.5, rel=0.1)


def test_a_first_line_that_may_lack_its_beginning_is_left_out():
    options = ReaderOptions(columns=(0, 1, 2), units="deg/s", time_column=3, time_units="s")
    lines = [f"0.1,0.2,0.3,{n / RATE}" for n in range(200)]
    for within, header, count in ((True, [], 199), (False, [], 200), (True, ["gx,gy,gz,t"], 200)):
        parser = Parser(options, None, within)
        assert sum(len(rates) for _, rates, *_ in parser.seconds([header + lines])) == count


@pytest.mark.parametrize("rows", [1, 10, 40])
def test_a_rate_is_inferred_across_bursts_or_a_gap_however_lines_arrive(rows):
    options = ReaderOptions(columns=(0, 1, 2), units="deg/s", time_column=3, time_units="s")
    for burst, gap in ((1, 500), (40, 0)):
        number = np.arange(2000) + gap * (np.arange(2000) > 1000)
        times = (number // burst * burst) / RATE + number % burst * 1e-4
        lines = [f"0.1,0.2,0.3,{time:.4f}" for time in times]
        parser = Parser(options, None)
        batches = (lines[start : start + rows] for start in range(0, len(lines), rows))
        assert sum(len(samples) for _, samples, *_ in parser.seconds(batches)) == len(lines)
        parser.check_rate()
        assert parser.rate_hz == pytest.approx(RATE, rel=0.05)


def test_a_rate_that_changes_is_refused_and_nothing_is_stored():
    times = np.cumsum(np.where(np.arange(1000) < 300, 0.02, 0.01))
    rows = np.column_stack([times, rates(10)]).tolist()
    lines = ["t (s),gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s)"]
    reading, writing = os.pipe()
    lines += [",".join(f"{x:.6g}" for x in row) for row in rows]
    sender = threading.Thread(target=send_slowly, args=(writing, lines))
    sender.start()
    with os.fdopen(reading, "rb") as source:
        done = run("stream", "--type", "memsense", "--device", "B17", input=source)
    sender.join()
    assert (done.exit_code, "expected times at one rate" in done.stderr) == (2, True)
    assert json.loads(run("devices", "list", "--json").stdout)[0]["calibrations"] == 0


def send_slowly(descriptor, lines):
    """Send lines in pieces that are read one by one."""
    for start in range(0, len(lines), 20):
        with suppress(BrokenPipeError):
            os.write(descriptor, "\n".join([*lines[start : start + 20], ""]).encode())
        time.sleep(0.005)
    os.close(descriptor)


def process(*arguments, **options):
    command = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    command += "from gyro_pipeline.calibrator.cli import main; main()"
    return subprocess.Popen([sys.executable, "-c", command, *arguments], text=True, **options)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_stream_like_its_end(number, tmp_path):
    about = ("stream", "--type", "memsense", "--device", "B17", "--target", "0.1", "--json")
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with process(*about, **pipes) as stream:
        assert json.loads(stream.stdout.readline())["seconds_at_rest"] == 0  # before any sample
        stream.stdin.write(text(rates(5)))
        stream.stdin.flush()
        while json.loads(stream.stdout.readline())["seconds_at_rest"] < 3:
            pass
        stream.send_signal(number)
        last = json.loads(stream.stdout.read().splitlines()[-1])
        assert (stream.wait(), stream.stderr.read()) == (3, "")
    (line,) = (tmp_path / "registry/B17/calibrations.jsonl").read_text().splitlines()
    assert json.loads(line)["mean_dps"] == last["bias_dps"]


def test_a_full_or_closed_output_loses_nothing_that_is_stored(csv, tmp_path):
    about = ("--type", "memsense", "--device")
    path = csv(rates(5))
    with open("/dev/full", "w") as full, open(path) as sent:
        pipes = {"stdout": full, "stderr": subprocess.PIPE}
        for command, options in ((("log", path), {}), (("stream",), {"stdin": sent})):
            with process(*command, *about, command[0], **pipes, **options) as done:
                words = done.stderr.read()
            assert (done.returncode, "No space left" in words) == (2, True)
    closed, writing = os.pipe()
    os.close(closed)
    with process("log", path, *about, "closed", stdout=writing) as done:
        os.close(writing)
    assert done.returncode == 0
    stored = json.loads(run("devices", "list", "--json").stdout)
    assert {one["device"]: one["calibrations"] for one in stored} == dict.fromkeys(
        ("closed", "log", "stream"), 1
    )


def test_a_sensor_that_sends_zeros_or_nothing_ends_the_stream(csv):
    zeros = "\n".join(f"{n / RATE},0,0,0" for n in range(500, 5000))
    reading, writing = os.pipe()
    lines = [*text(rates(5)).splitlines(), *zeros.splitlines()]
    sender = threading.Thread(target=send_slowly, args=(writing, lines))
    sender.start()
    options = ("--type", "memsense", "--timeout", "0.3")
    with os.fdopen(reading, "rb") as source:
        done = run("stream", *options, input=source)
        sender.join()
    assert (done.exit_code, "no usable sample came for 0.3 s" in done.stderr) == (0, True)
    run("log", csv(rates(5)), "--device", "B17", "--type", "memsense")
    done = streamed("--device", "B17", "--timeout", "0.1", send="", close=False)
    first, last = map(json.loads, done.stdout.splitlines() + ["0"])
    np.testing.assert_allclose(first["bias_dps"], rates(5).mean(axis=0), atol=1e-3)
    assert (done.exit_code, last, "expected samples, got none" in done.stderr) == (6, 0, True)


def test_a_stream_of_json_lines_with_rows_that_are_none():
    names = ("t (s)", "gyro_x (deg/s)", "gyro_y (deg/s)", "gyro_z (deg/s)")
    values = rates(5).round(3)
    rows = [dict(zip(names, [n / RATE, *row], strict=True)) for n, row in enumerate(values)]
    rows[400][names[1]] = None
    lines = [json.dumps(row) for row in rows]
    lines[300] = lines[300][:10]
    done = streamed("--json", send="\n".join(lines))
    assert done.exit_code == 0
    assert "1 lines were of another shape" in done.stderr
    reasons = {reason["code"] for reason in json.loads(done.stdout.splitlines()[-1])["reasons"]}
    assert "not_finite" in reasons


def test_a_sensor_that_stops_sends_no_times_or_begins_within_a_line_is_said():
    stopped = ("--target", "1", "--timeout", "0.1")
    done = streamed(*stopped, send=text(rates(5)), close=False)
    assert (done.exit_code, "no usable sample came for 0.1 s" in done.stderr) == (3, True)
    assert "needs" in done.stdout
    header = "gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s)"
    rows = "\n".join([header, *(["0.1,0.2,0.3"] * 30)])
    assert "give --rate" in streamed(send=rows).stderr
    done = streamed("--increments", "true", send=text(rates(5)))  # not what a stream divides
    assert (done.exit_code, "--increments: expected a log file" in done.stderr) == (2, True)
    done = streamed(send='{"t (s)": 0.0, "gyro_x (d\n' + '{"t (s)": 0.01}\n' * 30)
    assert (done.exit_code, "got 't (s)'" in done.stderr) == (2, True)


def test_a_serial_port():
    pytest.importorskip("serial")
    master, slave = os.openpty()

    def send():
        while termios.tcgetattr(master)[3] & termios.ICANON:  # until the port is open
            time.sleep(0.01)
        time.sleep(0.2)  # opening it discards what came before
        for line in text(rates(5)).splitlines(keepends=True):
            os.write(master, line.encode())

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    port = ("--port", os.ttyname(slave), "--timeout", "1")
    answer, done = said("stream", *port, "--type", "memsense")
    sender.join()
    assert (done.exit_code, answer["seconds_at_rest"]) == (0, 5)
    assert "no usable sample came" in done.stderr
    np.testing.assert_allclose(answer["bias_dps"], rates(5).mean(axis=0), atol=1e-6)


def test_a_picture_is_drawn_and_a_failure_loses_no_calibration(csv, tmp_path, monkeypatch):
    figure = pytest.importorskip("matplotlib.figure").Figure
    about = ("log", csv(rates(10)), "--type", "memsense", "--device", "B17", "--plot")
    for name, words in (("a.xyz", ".png"), ("nowhere/a.png", "can be written")):
        result = run(*about, tmp_path / name)
        assert (result.exit_code, result.stdout, words in result.stderr) == (2, "", True)

    result = run(*about, tmp_path / "a.png", csv(rates(5), "b.csv"))
    assert (result.exit_code, "expected one log, got 2" in result.stderr) == (2, True)
    assert run(*about, tmp_path / "a.png", "--no-store").exit_code == 0
    assert (tmp_path / "a.png").stat().st_size > 10_000
    full = Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(figure, "savefig", full)
    result = run(*about, tmp_path / "a.png")
    assert (result.exit_code, "No space left" in result.stderr) == (2, True)
    assert run("devices", "list").stdout.split()[:3] == ["B17", "memsense", "1"]
