"""Against a server on this machine that misbehaves as asked."""

import re
import threading
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from kedro.io import DatasetError
from tenacity import wait_none

from gyro_pipeline.conventions import InputError
from gyro_pipeline.datasets import download
from gyro_pipeline.datasets.download import blob_id, ensure
from gyro_pipeline.datasets.published_logs import PublishedLogs

CONTENT = np.random.default_rng(0).bytes(300_000)
HALF = len(CONTENT) // 2
URL_PATH = "/data/made.npy"
SMALL = {"sparkfun": ("sf", 4), "dot": ("dots", 4), "ng": ("ng", 2), "memsense": ("memsense", 2)}


class Server:
    """Serves ``files``; what ``faults`` holds answers one request each before that."""

    def __init__(self):
        self.files, self.faults, self.asked = {}, [], []
        self.gives_parts, self.test_is_over = True, threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                outer.asked.append((self.path, self.headers["Range"]))
                assert self.headers["Accept-Encoding"] == "identity"
                (outer.faults.pop(0) if outer.faults else outer.send)(self)

            def log_message(self, *_):
                """Nothing on the terminal."""

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        self.address = f"http://127.0.0.1:{self.http.server_port}"

    @property
    def ranges(self):
        return [part for _, part in self.asked]

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
        request.wfile.flush()
        return None

    def cut(self, request):
        """Half of it, then the connection ends."""
        self.send(request, HALF)

    def silent(self, request):
        self.test_is_over.wait(20)

    def endless(self, request):
        """Bytes for ever, of a length that is not said."""
        request.send_response(200)
        request.end_headers()
        try:
            while not self.test_is_over.is_set():
                request.wfile.write(bytes(10**4))
        except OSError:
            pass  # nobody reads on

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
    server.files |= dict.fromkeys([URL_PATH, "/elsewhere"], CONTENT)
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
    return download.hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def fetch(server, path):
    ensure(server.address + URL_PATH, path, id_of(CONTENT))


def fetched(server, path):
    fetch(server, path)
    assert path.read_bytes() == CONTENT
    assert left(path) == [path.name]


def refusal(server, path):
    with pytest.raises(InputError) as caught:
        fetch(server, path)
    return str(caught.value)


def left(path):
    """Files in its folder; the lock is empty, and its being there says nothing."""
    return sorted(file.name for file in path.parent.iterdir() if file.name != ".lock")


def test_a_missing_file_is_fetched_whole_and_a_present_one_verified(server, path):
    fetched(server, path)
    before = path.stat().st_mtime_ns
    (path.parent / ".lock").unlink()
    ensure("http://127.0.0.1:9/made.npy", path, id_of(CONTENT))  # which no server answers
    assert server.asked == [(URL_PATH, None)]
    assert path.stat().st_mtime_ns == before
    assert not (path.parent / ".lock").exists()  # a folder that cannot be written to will do
    path.write_bytes(b"mine")
    message = refusal(server, path)
    assert message.startswith(f"{path} is not the published file: expected git blob id ")
    assert f"{id_of(CONTENT)}, got {id_of(b'mine')}" in message
    assert path.read_bytes() == b"mine"
    assert len(server.asked) == 1


def test_a_wrong_or_an_endless_file_is_refused_and_nothing_of_it_is_kept(server, path, monkeypatch):
    wrong = CONTENT[:-1] + bytes([CONTENT[-1] ^ 1])
    server.files[URL_PATH] = wrong
    message = refusal(server, path)
    assert f"expected the file of git blob id {id_of(CONTENT)}, got {id_of(wrong)}" in message
    assert left(path) == []
    assert server.ranges == [None]
    monkeypatch.setattr(download, "_LARGEST", 1000)
    server.faults = [server.endless]
    assert "more than 0.001 MB came" in refusal(server, path)
    assert path.with_name(".made.npy.part").stat().st_size == 0


@pytest.mark.parametrize(("code", "tries"), [(404, 1), (503, 5)])
def test_a_busy_server_is_asked_again_and_another_answer_is_final(server, path, code, tries):
    server.faults = [server.status(code)] * 5
    message = refusal(server, path)
    assert f"cannot fetch made.npy from {server.address}{URL_PATH}: {code} " in message
    assert "published_address" in message and f"put the file at {path} by hand" in message
    assert len(server.asked) == tries
    assert left(path) == []
    server.faults = [server.status(503)] * 2
    fetched(server, path)


def test_a_cut_connection_is_continued_from_where_it_broke_behind_redirections_too(server, path):
    server.faults = [server.redirect, server.cut, server.redirect]
    fetched(server, path)
    assert server.asked[2:] == [(URL_PATH, f"bytes={HALF}-"), ("/elsewhere", f"bytes={HALF}-")]
    path.unlink()
    server.asked.clear()
    server.gives_parts, server.faults = False, [server.cut]
    fetched(server, path)
    assert server.ranges == [None, f"bytes={HALF}-"]  # a server that gives no parts


@pytest.mark.slow
def test_a_later_run_goes_on_where_an_earlier_one_gave_up(server, path, monkeypatch):
    monkeypatch.setattr(download, "_TIMEOUT_S", 0.1)
    server.faults = [server.silent, server.cut] + [server.silent] * 3
    message = refusal(server, path)
    assert "timed out" in message
    assert f"{HALF} bytes are kept, and the next run continues from there" in message
    assert left(path) == [".made.npy.part"]
    server.asked.clear()
    fetched(server, path)
    assert server.ranges == [f"bytes={HALF}-"]
    path.unlink()
    path.with_name(".made.npy.part").write_bytes(CONTENT + b"more")
    fetched(server, path)  # what leaves nothing to fetch is begun anew
    assert server.ranges[1:] == [f"bytes={len(CONTENT) + 4}-", None]


def test_two_at_once_fetch_it_once(server, path):
    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(fetch, server, path) for _ in range(2)]:
            done.result(20)
    assert path.read_bytes() == CONTENT
    assert len(server.asked) == 1


def array(recordings, gyroscopes, samples, seed=0):
    return np.random.default_rng(seed).normal(0, 0.05, (recordings, gyroscopes, samples))


def published_logs(server, folder, files, **options):
    entry = {"sensor": "made", "sensors": {"made": {}}, "source": "published_all"}
    entry |= {"address": server.address + "/base/", "path": str(folder / "raw")}
    return PublishedLogs(**entry, files=files, **options)


def test_logs_are_fetched_once_and_read_as_array_files_are(server, tmp_path):
    files, arrays = {}, {"train": array(6, 9, 200), "test": array(6, 9, 200, seed=1)}
    for split, values in arrays.items():
        np.save(tmp_path / "made.npy", values)
        content = (tmp_path / "made.npy").read_bytes()
        files[split] = {"remote": f"data/{split}.npy", "blob": id_of(content)}
        server.files[f"/base/data/{split}.npy"] = content
    order = ["recording", "gyroscope", "sample"]  # which the shapes leave open
    logs = published_logs(server, tmp_path, files, axes_order=order)
    assert not logs.exists()
    for _ in range(2):
        listed = logs.load().entries
    assert logs.exists()
    assert server.asked == [("/base/data/train.npy", None), ("/base/data/test.npy", None)]
    np.testing.assert_array_equal(listed[11].read().samples, arrays["test"][5, :3].T)
    with pytest.raises(DatasetError, match="read only"):
        logs.save(xr.Dataset())


def test_a_wrong_entry_is_refused_before_anything_is_fetched(server, tmp_path):
    blob = id_of(CONTENT)
    for file in ({"blob": blob}, {"remote": "a.npy", "blob": blob, "sha256": "0"}):
        with pytest.raises(InputError, match="made: files: all: expected remote"):
            published_logs(server, tmp_path, {"all": file})
    assert server.asked == []


def test_the_real_file_has_the_blob_id_that_the_environment_asks_for(real_file):
    path = real_file("memsense_test_real.npy")
    catalog = Path(__file__).parents[2] / "conf" / "published" / "catalog.yml"
    assert f"{path.name}, blob: {blob_id(path)}" in catalog.read_text()


def test_the_environment_reads_the_published_files_of_all_sensors(server, new_project):
    project = new_project()
    conf, raw = project.folder / "conf/published", project.folder / "data/01_raw"
    sensors = dict.fromkeys(SMALL, {"samples": 1300})  # a tenth of the rate
    (conf / "globals.yml").write_text(f"source: published_all\nsensors: {sensors}\n")
    text = (conf / "catalog.yml").read_text()
    for name, imus in SMALL.values():
        for split, recordings, gyroscopes in (("train", 5, 3 * imus), ("test", 2, 3)):
            remote = f"data/{split}/{name}_{split}_real.npy"
            file = project.folder / "file.npy"
            np.save(file, array(recordings, gyroscopes, 1300, seed=len(server.files)))
            server.files[f"/{remote}"] = file.read_bytes()
            text, found = re.subn(rf"{remote}, blob: \w+", f"{remote}, blob: {blob_id(file)}", text)
            assert found == 1
    (conf / "catalog.yml").write_text(text)
    done = project.run_here("ground_truth", "published", published_address=server.address)
    assert done.code == 0, done.output
    for sensor, (_, imus) in SMALL.items():
        folder = project.folder / "data/02_intermediate/published_all" / sensor
        with xr.open_dataset(folder / "recordings.nc") as recordings:
            assert (recordings.sizes["imu"], recordings.sizes["recording"]) == (imus, 7)
            assert recordings.split.values.tolist() == ["train"] * 5 + ["test"] * 2
            assert recordings.attrs["simulated"] == 0
    assert len(list((raw / "published").glob("*.npy"))) == 8
