"""Against a server on this machine that misbehaves as asked."""

import os
import re
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from kedro.io import DatasetError
from tenacity import wait_none

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets import download
from gyro_pipeline.datasets.download import blob_id, ensure
from gyro_pipeline.datasets.published_logs import PublishedLogs

ROOT = Path(__file__).parents[2]
REAL_FILE = "memsense_test_real.npy"
REAL_BLOB = "c6506fc8b50fe58a20dc3c7cd995a658871ac3d7"
CONTENT = np.random.default_rng(0).bytes(300_000)
HALF = len(CONTENT) // 2
KEPT = 131_072  # whole pieces in half of it
URL_PATH = "/data/made.npy"
SENSOR = {
    "imus": 1,
    "recordings": 7,
    "train_recordings": 5,
    "samples": 200,
    "recording_s": 2,
    "simulated": {
        "noise_mdps_rts": [5, 5, 5],
        "turn_on_spread_mdps": [0, 0, 0],
        "unit_bias_dps": 0.5,
    },
}


class Server:
    """Serves ``files``; what ``faults`` holds answers one request each before that."""

    def __init__(self):
        self.files, self.faults, self.asked = {}, [], []
        self.gives_parts = True
        self.test_is_over = threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                outer.asked.append((self.path, self.headers["Range"]))
                assert self.headers["Accept-Encoding"] == "identity"
                (outer.faults.pop(0) if outer.faults else outer.good)(self)

            def log_message(self, *_):
                """Nothing on the terminal."""

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        self.address = f"http://127.0.0.1:{self.http.server_port}"

    @property
    def ranges(self):
        return [part for _, part in self.asked]

    def good(self, request):
        self.send(request)

    def send(self, request, upto=None):
        content, start = self.files.get(request.path), 0
        if content is None:
            return request.send_error(404)
        if self.gives_parts and request.headers["Range"]:
            start = int(re.fullmatch(r"bytes=(\d+)-", request.headers["Range"])[1])
            if start >= len(content):
                return request.send_error(416)
        request.send_response(206 if start else 200)
        request.send_header("Content-Length", str(len(content) - start))
        request.end_headers()
        request.wfile.write(content[start:upto])
        return None

    def cut(self, request):
        """Half of it, then the connection ends."""
        self.send(request, HALF)
        request.wfile.flush()

    def hang(self, request):
        """Half of it, then nothing comes any more."""
        self.cut(request)
        self.test_is_over.wait(20)

    def silent(self, request):
        self.test_is_over.wait(20)

    @staticmethod
    def status(code):
        return lambda request: request.send_error(code)

    def redirect(self, request):
        request.send_response(302)
        request.send_header("Location", "/elsewhere")
        request.send_header("Content-Length", "0")
        request.end_headers()


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("NO_PROXY", "*")
    monkeypatch.setattr(download._append_rest.retry, "wait", wait_none())
    server = Server()
    server.files[URL_PATH] = CONTENT
    thread = threading.Thread(target=server.http.serve_forever, args=(0.01,))
    thread.start()
    yield server
    server.test_is_over.set()
    server.http.shutdown()
    server.http.server_close()
    thread.join()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "new" / "made.npy"


def id_of(content):
    """By git's own definition."""
    header = b"blob %d\0" % len(content)
    return download.hashlib.sha1(header + content).hexdigest()


def fetch(server, path, blob=None):
    ensure(server.address + URL_PATH, path, blob or id_of(CONTENT))


def refusal(server, path, blob=None):
    with pytest.raises(InputError) as caught:
        fetch(server, path, blob)
    return str(caught.value)


def left(path):
    """Files in its folder; the lock is empty, and its being there says nothing."""
    return sorted(one.name for one in path.parent.iterdir() if one.name != ".lock")


# fetching


@pytest.mark.parametrize(
    ("content", "blob"),
    [
        (b"", "e69de29bb2d1d6434b8b29ae775ad8c2e48c5391"),
        (b"hello\n", "ce013625030ba8dba906f756967f9e9ca394464a"),
    ],
)
def test_blob_ids_are_those_of_git_hash_object(tmp_path, content, blob):
    file = tmp_path / "file"
    file.write_bytes(content)
    assert blob_id(file) == blob


def test_a_missing_file_is_fetched_whole(server, path):
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert left(path) == ["made.npy"]
    assert server.asked == [(URL_PATH, None)]


def test_a_present_file_is_verified_and_not_fetched(server, path):
    fetch(server, path)
    fetch(server, path)
    assert len(server.asked) == 1


def test_a_present_file_needs_no_server_and_no_writable_folder(tmp_path):
    path = tmp_path / "made.npy"
    path.write_bytes(CONTENT)
    before = path.stat().st_mtime_ns
    ensure("http://127.0.0.1:9/made.npy", path, id_of(CONTENT))
    assert [one.name for one in tmp_path.iterdir()] == ["made.npy"]
    assert path.stat().st_mtime_ns == before


def test_another_file_that_is_there_is_refused_and_left_alone(server, path):
    path.parent.mkdir()
    path.write_bytes(b"mine")
    message = refusal(server, path)
    assert message.startswith(f"{path} is not the published file: expected git blob id ")
    assert f"{id_of(CONTENT)}, got {id_of(b'mine')}" in message
    assert path.read_bytes() == b"mine"
    assert server.asked == []


@pytest.mark.parametrize(
    "wrong",
    [CONTENT[:HALF], CONTENT[:-1] + bytes([CONTENT[-1] ^ 1]), b"", b"<html>sign in first</html>"],
    ids=["truncated", "one bit changed", "empty", "a sign-in page"],
)
def test_a_wrong_file_is_refused_and_nothing_of_it_is_kept(server, path, wrong):
    server.files[URL_PATH] = wrong
    message = refusal(server, path)
    assert f"expected the file of git blob id {id_of(CONTENT)}, got {id_of(wrong)}" in message
    assert f"{len(wrong)} bytes" in message
    assert left(path) == []
    assert server.ranges == [None]
    server.files[URL_PATH] = CONTENT
    fetch(server, path)
    assert path.read_bytes() == CONTENT


def test_a_file_that_is_not_published_is_refused_at_once(server, path):
    del server.files[URL_PATH]
    message = refusal(server, path)
    assert f"cannot fetch made.npy from {server.address}{URL_PATH}" in message
    assert "the server answered 404 Not Found" in message
    assert "published_address" in message
    assert len(server.asked) == 1
    assert left(path) == []


@pytest.mark.parametrize("code", [429, 500, 503])
def test_a_busy_server_is_asked_again(server, path, code):
    server.faults = [server.status(code)] * 2
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert len(server.asked) == 3


def test_a_server_that_stays_busy_is_given_up(server, path):
    server.faults = [server.status(503)] * 9
    assert "the server answered 503" in refusal(server, path)
    assert len(server.asked) == 5
    assert left(path) == []


def test_no_network(server, path):
    server.http.shutdown()
    server.http.server_close()
    message = refusal(server, path)
    assert "Connection refused" in message
    assert f"put the file at {path} by hand" in message
    assert left(path) == []


def test_an_address_that_is_none(path):
    with pytest.raises(InputError, match="No connection adapters"):
        ensure("ftp://127.0.0.1/made.npy", path, id_of(CONTENT))


# going on after an interruption


def test_a_cut_connection_is_continued_from_where_it_broke(server, path):
    server.faults = [server.cut]
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert server.ranges == [None, f"bytes={KEPT}-"]


def test_a_server_that_gives_no_parts_is_asked_for_the_whole(server, path):
    server.gives_parts = False
    server.faults = [server.cut]
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert server.ranges == [None, f"bytes={KEPT}-"]


def test_parts_are_asked_for_behind_a_redirection_too(server, path):
    server.files["/elsewhere"] = CONTENT
    server.faults = [server.redirect, server.cut, server.redirect]
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert server.asked[2:] == [(URL_PATH, f"bytes={KEPT}-"), ("/elsewhere", f"bytes={KEPT}-")]


def test_a_server_that_goes_silent_is_left_after_a_while_and_continued(server, path, monkeypatch):
    monkeypatch.setattr(download, "_TIMEOUT_S", 0.2)
    server.faults = [server.silent, server.hang]
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert server.ranges == [None, None, f"bytes={KEPT}-"]


def test_a_later_run_goes_on_where_an_earlier_one_gave_up(server, path, monkeypatch):
    monkeypatch.setattr(download, "_TIMEOUT_S", 0.1)
    server.faults = [server.hang] + [server.silent] * 4
    message = refusal(server, path)
    assert "timed out" in message
    assert f"{KEPT} bytes are kept, and the next run goes on from there" in message
    assert left(path) == [".made.npy.part"]
    server.asked.clear()
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert server.ranges == [f"bytes={KEPT}-"]
    assert left(path) == ["made.npy"]


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_a_later_run_goes_on_where_a_process_ended(server, path, end):
    server.faults = [server.hang]
    arguments = server.address + URL_PATH, str(path), id_of(CONTENT)
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from pathlib import Path; from gyro_pipeline.datasets.download import ensure\n"
        f"ensure({arguments[0]!r}, Path({arguments[1]!r}), {arguments[2]!r})"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    part = path.with_name(".made.npy.part")
    process = subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=-3)
    try:
        for _ in range(2000):
            if part.exists() and part.stat().st_size:
                break
            server.test_is_over.wait(0.01)
    finally:
        process.send_signal(end)
        process.wait(10)
    assert process.returncode != 0
    assert not path.exists()
    assert 0 < part.stat().st_size <= HALF
    begun = part.stat().st_size
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert server.ranges == [None, f"bytes={begun}-"]


@pytest.mark.parametrize("part", [CONTENT, CONTENT + b"more"], ids=["whole", "longer"])
def test_a_part_that_leaves_nothing_to_fetch_is_begun_anew(server, path, part):
    path.parent.mkdir()
    path.with_name(".made.npy.part").write_bytes(part)
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert server.ranges == [f"bytes={len(part)}-", None]


def test_a_part_of_another_file_is_found_out(server, path):
    path.parent.mkdir()
    path.with_name(".made.npy.part").write_bytes(b"another file")
    assert "Run again" in refusal(server, path)
    assert left(path) == []
    fetch(server, path)
    assert path.read_bytes() == CONTENT


def test_two_at_once_fetch_it_once(server, path):
    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(fetch, server, path) for _ in range(2)]:
            done.result(20)
    assert path.read_bytes() == CONTENT
    assert len(server.asked) == 1


# a folder that cannot be written to


@contextmanager
def files_of_at_most(size) -> Iterator[None]:
    """Writing more fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk(server, path):
    with files_of_at_most(HALF):
        message = refusal(server, path)
    assert message.startswith(f"cannot write {path}: File too large in {path.parent}")
    assert "with space left" in message
    assert left(path) == [".made.npy.part"]
    fetch(server, path)
    assert path.read_bytes() == CONTENT


def test_a_file_where_the_folder_should_be(server, path):
    path.parent.write_bytes(b"")
    message = refusal(server, path)
    assert f"{path.parent} is a file where a folder is needed; move it away" in message


def test_a_folder_where_the_file_should_be(server, path):
    path.mkdir(parents=True)
    assert refusal(server, path) == f"cannot read {path}: Is a directory; move it away"
    assert server.asked == []


# the dataset


def array(recordings, gyroscopes, samples, seed=0):
    return np.random.default_rng(seed).normal(0, 0.05, (recordings, gyroscopes, samples))


def publish(server, folder, **arrays):
    """Put arrays on the server; gives the ``files`` of a catalog entry."""
    files = {}
    for split, values in arrays.items():
        file = folder / f"{split}.npy"
        np.save(file, values)
        content = file.read_bytes()
        file.unlink()
        server.files[f"/base/data/{split}/made_{split}.npy"] = content
        files[split] = {"remote": f"data/{split}/made_{split}.npy", "blob": id_of(content)}
    return files


def published_logs(server, folder, files, **options):
    return PublishedLogs(
        sensor="made",
        sensors={"made": SENSOR},
        source="published_all",
        address=server.address + "/base/",
        path=str(folder / "raw"),
        files=files,
        **options,
    )


def refused_load(logs):
    with pytest.raises(DatasetError) as caught:
        logs.load()
    assert isinstance(caught.value.__cause__, InputError)
    return str(caught.value.__cause__)


def test_logs_are_fetched_once_and_read_as_array_files_are(server, tmp_path):
    train, test = array(5, 3, 200), array(2, 3, 200, seed=1)
    logs = published_logs(server, tmp_path, publish(server, tmp_path, train=train, test=test))
    assert not logs.exists()
    first, again = logs.load(), logs.load()
    assert type(first) is type(logs._arrays.load()) is type(again)
    assert logs.exists()
    assert server.asked == [
        ("/base/data/train/made_train.npy", None),
        ("/base/data/test/made_test.npy", None),
    ]
    np.testing.assert_array_equal(np.load(tmp_path / "raw/made_test.npy"), test)


def test_a_shape_that_leaves_the_axes_open_is_refused_and_axes_order_settles_it(server, tmp_path):
    files = publish(server, tmp_path, all=array(6, 9, 200))
    message = refused_load(published_logs(server, tmp_path, files))
    assert "made_all.npy of shape (6, 9, 200): axes_order in the catalog entry" in message
    order = ["recording", "gyroscope", "sample"]
    assert published_logs(server, tmp_path, files, axes_order=order).load() is not None


@pytest.mark.parametrize(
    "file",
    [
        {"remote": "a.npy"},
        {"blob": REAL_BLOB},
        {"remote": "a.npy", "blob": REAL_BLOB[:-1]},
        {"remote": "a.npy", "blob": REAL_BLOB.upper()},
        {"remote": "a.npy", "blob": REAL_BLOB, "sha256": "0"},
    ],
)
def test_a_wrong_entry_is_refused_before_anything_is_fetched(server, tmp_path, file):
    with pytest.raises(InputError, match="made: files: all: expected remote"):
        published_logs(server, tmp_path, {"all": file})
    assert server.asked == []


def test_logs_are_read_only(server, tmp_path):
    logs = published_logs(server, tmp_path, publish(server, tmp_path, all=array(5, 3, 200)))
    with pytest.raises(DatasetError, match="read only"):
        logs.save(xr.Dataset())


# the environments


def real_file():
    folder = os.environ.get("GYRO_PIPELINE_REAL_DATA")
    if not folder or not Path(folder, REAL_FILE).is_file():
        pytest.skip(f"GYRO_PIPELINE_REAL_DATA does not name the folder of {REAL_FILE}")
    return Path(folder, REAL_FILE)


def test_the_real_file_is_fetched_and_has_the_published_blob_id(server, tmp_path):
    server.files[URL_PATH] = real_file().read_bytes()
    server.faults = [server.cut]
    path = tmp_path / REAL_FILE
    fetch(server, path, REAL_BLOB)
    assert path.read_bytes() == real_file().read_bytes()
    assert len(server.asked) == 2


def test_the_real_file_truncated_or_changed_is_refused(server, tmp_path):
    content = real_file().read_bytes()
    for wrong in (content[:-8], content[:1000] + b"\0" + content[1001:]):
        assert wrong != content
        server.files[URL_PATH] = wrong
        assert REAL_BLOB in refusal(server, tmp_path / REAL_FILE, REAL_BLOB)
        assert left(tmp_path / REAL_FILE) == []


SMALL = {"sparkfun": ("sf", 4), "dot": ("dots", 4), "ng": ("ng", 2), "memsense": ("memsense", 2)}


@pytest.fixture
def made_up(server, new_project):
    """A project whose environment ``published`` asks for the blob ids of small files."""
    project = new_project(with_store=False)
    conf = project.folder / "conf/published"
    sensors = dict.fromkeys(SMALL, {"samples": 1300})  # a tenth of the rate
    (conf / "globals.yml").write_text(f"source: published_all\nsensors: {sensors}\n")
    catalog = conf / "catalog.yml"
    text = catalog.read_text()
    for name, imus in SMALL.values():
        for split, recordings, gyroscopes in (("train", 5, 3 * imus), ("test", 2, 3)):
            remote = f"data/{split}/{name}_{split}_real.npy"
            file = project.folder / "one.npy"
            np.save(file, array(recordings, gyroscopes, 1300, seed=len(server.files)))
            server.files[f"/{remote}"] = file.read_bytes()
            text, found = re.subn(rf"{remote}, blob: \w+", f"{remote}, blob: {blob_id(file)}", text)
            assert found == 1
    catalog.write_text(text)
    return project


def test_the_environment_reads_the_published_files_of_all_sensors(server, made_up):
    done = made_up.run_here("ground_truth", "published", published_address=server.address)
    assert done.code == 0, done.output
    assert len(server.asked) == 8
    for sensor, (_, imus) in SMALL.items():
        folder = made_up.folder / "data/02_intermediate/published_all" / sensor
        with xr.open_dataset(folder / "recordings.nc") as recordings:
            assert (recordings.sizes["imu"], recordings.sizes["recording"]) == (imus, 7)
            held_out = recordings.split.values == "test"
            assert held_out.tolist() == [False] * 5 + [True] * 2
            assert recordings.attrs["simulated"] == 0
    raw = made_up.folder / "data/01_raw/published"
    assert len([one for one in raw.iterdir() if one.suffix == ".npy"]) == 8


def test_of_devices_that_are_unseen_those_with_test_recordings_are_tested(server, made_up):
    given = {"published_address": server.address, "only": {"sensor": "dot", "window_s": 10.0}}
    done = made_up.run_here("unseen_devices", "published", **given, evaluation={"resamples": 100})
    assert done.code == 0, done.output
    folder = made_up.folder / "data/05_model_input/published_all/dot"
    windows = pd.read_parquet(folder / "unseen_devices_windows.parquet")
    assert windows.fold.unique().tolist() == ["without IMU 1", "all recordings"]
    judged = windows[windows.fold == "without IMU 1"]
    assert set(zip(judged.imu, judged.role, strict=True)) == {
        (1, "test"),
        *((imu, "train") for imu in (2, 3, 4)),
    }


def test_a_run_without_a_file_of_its_own_ends_with_a_message(server, made_up):
    del server.files["/data/test/sf_test_real.npy"]
    done = made_up.run_here("ground_truth", "published", published_address=server.address)
    assert done.code != 0
    assert "error: cannot fetch sf_test_real.npy from http://" in done.output
    assert "Traceback" not in done.output
    assert not (made_up.folder / "data/01_raw/published/sf_test_real.npy").exists()


def test_an_address_that_is_none_is_refused_before_anything_runs(made_up):
    done = made_up.run_here("ground_truth", "published", published_address="our mirror")
    assert done.code != 0
    assert "published_address" in done.output
    assert not (made_up.folder / "data/01_raw").exists()
