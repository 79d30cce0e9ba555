"""The registry: nothing that was stored is lost, whatever happens while it is written."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict

import pytest

from gyro_pipeline.calibrator import Calibration, Calibrator, registry
from gyro_pipeline.calibrator.device_types import type_of
from gyro_pipeline.calibrator.registry import Device, RegistryError, Settings
from gyro_pipeline.conventions import InputError


def opened(device, registry, **options):
    return Calibrator.open(device, rate_hz=100.0, registry=registry, **options)


def line(number, **more):
    made = {"seconds": 10.0, "hash": f"{number:04d}", "source": f"{number}.csv"}
    return asdict(Calibration((0.1, 1 / 3, number * 1e-3), (1e-6,) * 3, **made)) | more


@pytest.fixture
def device(tmp_path):
    device = Device(tmp_path, "B17")
    device.create("dot")
    return device


def test_what_is_stored_comes_back_in_order(device, tmp_path):
    for number in range(3):
        assert device.append(line(number))
    assert not device.append(line(1))  # the same log
    given = opened("B17", tmp_path)
    means = [tuple(calibration.mean) for calibration in given.setup.history]
    assert means == [(0.1, 1 / 3, n * 1e-3) for n in range(3)]
    assert given.setup.device_type.type == "dot"
    assert len(opened("B17", tmp_path, without="0002").setup.history) == 2


def test_rejected_and_forgotten_calibrations_stay_and_do_not_count(device, tmp_path):
    device.append(line(1))
    device.append(line(2, rest="moving", mean_dps=None, variance_dps2=None))
    device.append({"event": "forget", "time": 0.0, "of": "0001"})
    assert opened("B17", tmp_path).setup.history == ()
    assert len(device.lines()) == 3
    assert device.append(line(1))  # again, after it was forgotten
    assert len(opened("B17", tmp_path).setup.history) == 1


def test_a_line_that_was_cut_off_is_left_out_and_the_next_starts_anew(device):
    device.append(line(1))
    with device.lines_path.open("ab") as file:
        file.write(b'{"event": "calibration", "hash": "00')
    device.append(line(2))
    assert list(device.calibrations()) == ["0001", "0002"]


def test_a_full_disk_leaves_the_history_as_it_was(device, monkeypatch):
    device.append(line(1))
    before, write = device.lines_path.read_bytes(), os.write
    monkeypatch.setattr(registry.os, "write", lambda fd, data: write(fd, data[:20]))
    with pytest.raises(RegistryError, match="nothing can be stored: No space left"):
        device.append(line(2))
    with pytest.raises(RegistryError, match="No space left"):  # said before measuring as well
        device.create()
    assert device.lines_path.read_bytes() == before


WRITER = """
import sys; from pathlib import Path; from test_registry import line
from gyro_pipeline.calibrator.registry import Device
device = Device(Path(sys.argv[1]), "B17")
for number in range(int(sys.argv[2]), int(sys.argv[3])):
    device.append(line(number)); print(number, flush=True)
"""


def writer(folder, first, last):
    here = os.path.dirname(__file__)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([here, *sys.path])}
    command = [sys.executable, "-c", WRITER, str(folder), str(first), str(last)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_two_processes_take_turns_and_a_kill_loses_nothing_that_was_acknowledged(device, tmp_path):
    both = [writer(tmp_path, 0, 20), writer(tmp_path, 20, 100_000)]
    both[0].communicate(timeout=60)
    acknowledged = [int(both[1].stdout.readline()) for _ in range(20)]
    time.sleep(0.05)
    both[1].send_signal(signal.SIGKILL)
    rest = [int(text) for text in both[1].communicate()[0].split()]
    stored = {int(key) for key in device.calibrations()}
    assert stored >= {*range(20), *acknowledged, *rest}
    assert device.append(line(999_999))


def test_a_device_moves_in_one_file_and_is_not_doubled(device, tmp_path):
    device.append(line(1))
    device.append({"event": "note", "time": 0.0, "text": "dropped on the floor"})
    content = json.loads(json.dumps(device.content()))
    other = Device(tmp_path / "elsewhere", "B18")
    for _ in range(2):
        other.restore(content, "B17.json")
    assert other.lines() == device.lines()
    assert other.settings() == Settings("dot")


def test_lines_and_saved_devices_that_are_invalid_are_refused(device, tmp_path):
    device.append(line(1))
    before, content = device.lines_path.read_bytes(), device.content()
    for text, words in {
        '{"event": "calibration", "hash": }': "expected JSON of a calibration",
        '{"hash": "0002"}': "expected JSON of a calibration",
        '{"event": "forget", "time": 0.0}': "expected JSON .* forget with of, got",
        '{"event": "note", "time": 0.0}': "expected JSON .* note with text",
        json.dumps(line(2, variance_dps2=(-1e-6, 1e-6, 1e-6))): "variance_dps2: expected 0 or more",
    }.items():
        device.lines_path.write_bytes(before + text.encode() + b"\n")
        with pytest.raises(InputError, match=f"line 2: {words}"):
            device.lines()
    other = Device(tmp_path, "B18")
    for bad in ({"device_toml": "type = 5.5.5"}, {"lines": [line(1), {"event": "forget"}]}):
        with pytest.raises(InputError, match=r"b17\.json: (device_toml|line 2): "):
            other.restore({**content, **bad}, "b17.json")
    assert not other.folder.exists()


@pytest.mark.parametrize("name", ["turn_on_mdps", "flicker_mdps", "noise_spread", "conflict_mdps"])
def test_figures_of_a_type_that_are_negative_are_refused(name):
    with pytest.raises(InputError, match=f"t.json: {name}: expected 0 or more, got -1"):
        type_of({name: -1.0}, "t.json")
    with pytest.raises(InputError, match="warm_up: time_constant_s: expected more than 0"):
        type_of({"warm_up": {"amplitude_mdps": -3, "spread_mdps": 1, "time_constant_s": 0}}, "t")


def test_names_that_are_no_folder_and_settings_that_cannot_be_read_are_refused(device, tmp_path):
    for name in ("types", "../up", "x" * 65):
        with pytest.raises(InputError, match="device: expected letters, digits"):
            Device(tmp_path, name)
    expected, north, perhaps = "expected .*", "latitude: .*, got 'N'", "mounted: .*, got 'perhaps'"
    refused = {"type = ": expected, "latitud = 32.0": expected, "latitude = 'N'": north}
    for text, words in {**refused, "mounted = 'perhaps'": perhaps}.items():
        device.settings_path.write_text(text)
        with pytest.raises(InputError, match=rf"device\.toml: {words}; correct it"):
            device.settings()
    device.settings_path.write_text('mounted = "false"')  # a text, which was once taken for true
    assert not device.settings().mounted


def test_what_device_toml_says_and_what_options_overrule(device, tmp_path):
    device.settings_path.write_text('type = "memsense"\nmounted = true\nlatitude = 32.0\n')
    options = {"device_type": "dot", "same_heading": False, "latitude_deg": 50.0}
    for given, expected in (({}, ("memsense", True, 32)), (options, ("dot", False, 50))):
        setup = opened("B17", tmp_path, **given).setup
        told = (setup.device_type.type, setup.now.same_heading, setup.now.latitude_deg)
        assert told == expected
