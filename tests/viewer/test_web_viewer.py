"""The web viewer's server: loopback only, one origin, any free port; and in a real browser."""

import contextlib
import http.client
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
from memory_drive import MemoryDrive
from recorded_drive import record

from bevcli.errors import OutputError
from bevcli.viewer import rerun_viewer
from bevcli.viewer.rerun_viewer import LiveView, WebViewer, web_viewer_assets

PAGE = {"/": b"<html>viewer</html>", "/re_viewer.js": b"js", "/re_viewer_bg.wasm": b"wasm", "/favicon.ico": b""}
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WITHOUT_A_GPU = "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"


@pytest.fixture(scope="module", autouse=True)
def servers_end_soon():
    """A server looks 50 times a second, instead of once, whether it is to end."""
    serve = WebViewer.serve_forever
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WebViewer, "serve_forever", lambda server, poll_interval: serve(server, poll_interval / 50))
        yield


@contextlib.contextmanager
def serving(recording: Path, content: bytes):
    recording.write_bytes(content)
    viewer = WebViewer(PAGE, recording)
    thread = threading.Thread(target=viewer.serve)
    thread.start()
    yield viewer
    viewer.close()
    thread.join(5)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("served") / "recording.rrd", b"RRF2 and so on") as viewer:
        yield viewer


def test_the_root_redirects_to_the_viewer_with_the_recording(viewer):
    with urllib.request.urlopen(viewer.address + "/?theme=light") as answer:
        assert parse_qs(urlsplit(answer.url).query)["theme"] == ["light"]
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(viewer.address + "/etc/passwd")
    with urllib.request.urlopen(viewer.address + "/?renderer=webgl") as answer:
        assert answer.headers["Content-Security-Policy"] == "connect-src 'self' blob: data:"
        query = parse_qs(urlsplit(answer.url).query)
        assert answer.read() == PAGE["/"]
    assert query == {"url": [f"{viewer.address}/recording.rrd"], "theme": ["dark"], "renderer": ["webgl"]}
    with urllib.request.urlopen(query["url"][0]) as answer:
        assert answer.read() == b"RRF2 and so on"


def test_only_loopback_can_reach_it(viewer):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing; finds the address of this machine
        except OSError:
            pytest.skip("this machine has no other address than loopback")
        own = probe.getsockname()[0]
    with pytest.raises(OSError), socket.create_connection((own, viewer.port), timeout=2):
        pass


def get(viewer, **headers) -> int:
    connection = http.client.HTTPConnection(viewer.host, viewer.port, timeout=5)
    connection.request("GET", "/recording.rrd", headers=headers)
    return connection.getresponse().status


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{}", "127.0.0.1.evil.example", "", "[::1", "localhost.x"]
)
def test_a_page_led_here_by_its_name_service_reads_nothing(viewer, host):
    assert get(viewer, Host=host.format(viewer.port)) == 403


@pytest.mark.parametrize("host", ["127.0.0.1:{}", "localhost:{}", "LOCALHOST", "[::1]:{}", "192.168.1.7:{}"])
def test_addresses_and_the_name_of_this_machine_are_served(viewer, host):
    assert get(viewer, Host=host.format(viewer.port)) == 200


def test_silent_connections_end(viewer, monkeypatch):
    monkeypatch.setattr(rerun_viewer._Handler, "timeout", 0.2)
    with socket.create_connection((viewer.host, viewer.port), timeout=5) as silent:
        assert silent.recv(1) == b""


def test_a_reset_connection_prints_nothing(tmp_path, capfd):
    with serving(tmp_path / "recording.rrd", bytes(50_000_000)) as viewer:
        for request in (b"GET /recording.rrd HTTP/1.1\r\nHost: localhost\r\n\r\n", b"GET /rec"):
            connection = socket.create_connection((viewer.host, viewer.port))
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # close by a reset
            connection.sendall(request)
            time.sleep(0.1)
            connection.close()
        time.sleep(0.2)
    assert capfd.readouterr() == ("", "")


def test_whatever_replaces_the_recording_is_not_served(tmp_path):
    recording = tmp_path / "recording.rrd"
    (tmp_path / "secret").write_bytes(b"secret")
    with serving(recording, b"RRF2 shown") as viewer:
        for replace in (lambda: None, lambda: recording.symlink_to(tmp_path / "secret"), lambda: os.mkfifo(recording)):
            recording.unlink()
            replace()
            with urllib.request.urlopen(viewer.address + "/recording.rrd", timeout=5) as answer:
                assert answer.read() == b"RRF2 shown"
            recording.touch()


@pytest.mark.parametrize("make", [lambda path: None, os.mkfifo, Path.mkdir])
def test_only_files_are_served(tmp_path, monkeypatch, make):
    make(tmp_path / "recording.rrd")
    with pytest.raises(OutputError, match=r"recording\.rrd: "):
        WebViewer(PAGE, tmp_path / "recording.rrd")
    (tmp_path / "served.rrd").touch()
    monkeypatch.setattr(rerun_viewer, "STOP_TIMEOUT_S", 0.2)
    WebViewer(PAGE, tmp_path / "served.rrd").close()  # one that never served can be closed


@pytest.fixture
def live_view(tmp_path, monkeypatch):
    """A live view of a recording that holds four bytes, without a viewer; and the open file."""
    monkeypatch.setattr(rerun_viewer, "display_is_there", lambda: False)
    monkeypatch.setattr(rerun_viewer, "web_viewer_assets", lambda: PAGE)
    view = LiveView()
    with (tmp_path / "recording.rrd").open("wb", buffering=0) as file:
        file.write(b"RRF2")
        view.open(tmp_path / "recording.rrd")
        yield view, file
    view.close()


def test_a_live_view_sends_what_is_appended(live_view):
    view, file = live_view
    with urllib.request.urlopen(view.server.address + "/recording.rrd", timeout=5) as answer:
        assert answer.read(4) == b"RRF2"
        file.write(b" frame 1")
        assert answer.read(8) == b" frame 1"
        file.write(b" the end")
        view.close()
        assert answer.read() == b" the end"


def test_another_site_reads_nothing_of_a_live_view(live_view):
    view, _ = live_view
    address = urlsplit(view.server.address)
    for method, path in (("GET", "/recording.rrd"), ("POST", "/recording.rrd"), ("POST", "/proxy")):
        connection = http.client.HTTPConnection(address.hostname, address.port, timeout=5)
        connection.request(method, path, headers={"Host": "evil.example", "Origin": "http://evil.example"})
        answer = connection.getresponse()
        assert answer.status in (403, 501)
        assert answer.getheader("Access-Control-Allow-Origin") is None
    with pytest.raises(OSError), socket.create_connection((address.hostname, 9876), timeout=2):
        pass


def test_a_port_in_use_is_replaced_by_another(viewer, tmp_path):
    (tmp_path / "recording.rrd").touch()
    second = WebViewer(PAGE, tmp_path / "recording.rrd", port=viewer.port)
    assert second.port != viewer.port
    second.server_close()


@pytest.mark.slow
def test_the_assets_are_the_files_of_the_viewer(viewer):
    assets = web_viewer_assets()
    assert assets["/re_viewer_bg.wasm"].startswith(b"\0asm")
    assert b"the_canvas_id" in assets["/"]
    assert b"fonts.googleapis" not in assets["/"]


def processor_seconds(process: subprocess.Popen) -> float:
    user, system = Path(f"/proc/{process.pid}/stat").read_text().split()[13:15]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


@pytest.mark.slow
def test_a_browser_shows_the_recording(tmp_path):
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: no browser to drive")
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    record(tmp_path / "recording.rrd", MemoryDrive(3))
    command = [sys.executable, "-m", "bevcli", "viz"]
    server = subprocess.Popen(
        [*command, str(tmp_path / "recording.rrd"), "--web"], stdout=subprocess.PIPE, text=True, bufsize=1
    )
    try:
        address = re.match(r"http://127\.0\.0\.1:\d+", server.stdout.readline()).group()
        with playwright.sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=WITHOUT_A_GPU.split())
            page = browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme="light")
            requested: list[str] = []
            page.on("request", lambda request: requested.append(request.url))
            page.goto(f"{address}/?renderer=webgl")
            image = wait_for_image(page)
            browser.close()
        assert looks_like_views(image)
        assert np.median(image[:20]) < 60  # the top bar is dark, in a light browser too
        assert {urlsplit(url).netloc for url in requested if url.startswith("http")} == {urlsplit(address).netloc}
        before = processor_seconds(server)
        time.sleep(3)
        assert processor_seconds(server) - before < 0.1  # no page is open: the server is idle
    finally:
        server.send_signal(signal.SIGINT)
    assert server.wait(10) == 130
    with pytest.raises(OSError):
        urllib.request.urlopen(address, timeout=2)


def wait_for_image(page, seconds: float = 240) -> np.ndarray:
    deadline = time.monotonic() + seconds
    while True:
        page.wait_for_timeout(2000)
        image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        if looks_like_views(image) or time.monotonic() > deadline:
            return image


def looks_like_views(image: np.ndarray) -> bool:
    """Whether the image has noise (the camera images) above and below, and the BEV view's blue vehicle between them."""
    height = len(image)
    image = image[:, : 3 * image.shape[1] // 4]  # curves and texts are to the right
    above, middle, below = image[: height // 4], image[height // 4 : 3 * height // 4], image[3 * height // 4 :]
    vehicle = (np.abs(middle.astype(int) - [250, 200, 90]).sum(-1) < 40).sum()
    return above.std() > 20 and below.std() > 20 and vehicle > 20
