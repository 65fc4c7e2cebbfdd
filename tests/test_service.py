"""The service of docs/service.md answers a request with the drawn image, and a mistake with one line."""

import json
import re
import threading
from base64 import b64encode
from http.client import HTTPConnection
from http.server import HTTPServer
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import bevcli

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/service.md").read_text()
STREET = ROOT / "samples/street"


@pytest.fixture
def service():
    """The program of the page, imported."""
    [program] = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    found = {"__name__": "drawing"}
    exec(compile(program, "drawing.py", "exec"), found)
    return SimpleNamespace(**found)


def post(port: int, body: object) -> tuple[int, bytes]:
    connection = HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("POST", "/", json.dumps(body))
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_service_draws_what_it_is_sent(service):
    service.Drawing.rig = bevcli.read_calibration(STREET / "calibration.json")
    service.Drawing.log_message = lambda *_: None
    server = HTTPServer(("127.0.0.1", 0), service.Drawing)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    front = (STREET / "images/CAM_FRONT/000000.jpg").read_bytes()
    status, drawn = post(server.server_port, {"CAM_FRONT": b64encode(front).decode()})
    image = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_COLOR)
    assert (status, image.shape) == (200, (640, 1920, 3))
    status, text = post(server.server_port, {"FRONT": b64encode(front).decode()})
    assert (status, text.decode().count("\n")) == (400, 0)
    assert "camera FRONT is not in the rig (it has CAM_FRONT, " in text.decode()
    cut = b64encode(front[:600]).decode()
    for body in ({"CAM_FRONT": ""}, {"CAM_FRONT": "not base64"}, {"CAM_FRONT": cut}, {"CAM_FRONT": 7}, [""]):
        status, text = post(server.server_port, body)
        assert (status, len(text.decode().splitlines())) == (400, 1), body
    server.shutdown()
