"""Access to the page: only from this machine, by its address, with its token."""

import http.client
import socket
import sys

import pytest

from conftest import needs_panel, run_refused
from serving import served

pytestmark = needs_panel
__all__ = ["served"]


def ask(served, path, method="GET", body=None, **headers):
    """Send a request without any changes; return status and response."""
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=60)
    names = {"Host": f"127.0.0.1:{served.port}"}
    names |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection.putrequest(method, path, skip_host=True)
    if body is not None:
        names.setdefault("Content-Length", str(len(body)))
    for name, value in names.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(body or None)
    answer = connection.getresponse()
    text = answer.read().decode(errors="replace")
    connection.close()
    return answer.status, text


def test_the_page_answers_at_its_address(served):
    assert len(served.token) >= 32
    status, text = ask(served, f"/{served.token}/")
    assert status == 200
    assert "<title>foamfit</title>" in text
    assert ask(served, f"/{served.token}/", Origin=f"http://127.0.0.1:{served.port}")[0] == 200
    folders = sorted(served.files.glob("foamfit-page-*/window-*"))
    assert folders
    assert all(path.stat().st_mode & 0o077 == 0 for path in (*folders, folders[0].parent))


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/favicon.ico",
        "/x{token}/",
        "/{short}/",
        "//{token}/",
        "/static/js/bokeh.min.js",
        "/ws",
    ],
)
def test_a_request_without_the_token_is_refused(served, path):
    path = path.format(token=served.token, short=served.token[:-1])
    assert ask(served, path)[0] == 403


@pytest.mark.parametrize("host", ["localhost:{port}", "evil.example:{port}", "127.0.0.1", "", None])
def test_another_host_is_refused(served, host):
    """Another host name that resolves to this machine (DNS rebinding) is rejected."""
    host = host and host.format(port=served.port)
    assert ask(served, f"/{served.token}/", Host=host)[0] in (400, 403)


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "http://localhost:{port}", "https://127.0.0.1:{port}", "null"]
)
@pytest.mark.parametrize("path", ["/{token}/", "/{token}/ws"])
def test_another_origin_is_refused(served, origin, path):
    origin, path = origin.format(port=served.port), path.format(token=served.token)
    more = {"Upgrade": "websocket", "Connection": "Upgrade"} if path.endswith("ws") else {}
    assert ask(served, path, Origin=origin, **more)[0] == 403


def test_it_listens_on_this_machine_alone(served):
    with socket.socket() as other:
        other.settimeout(2)
        try:
            address = socket.gethostbyname(socket.gethostname())
        except OSError:
            pytest.skip("this machine has no other address")
        if address.startswith("127."):
            pytest.skip("this machine has no other address")
        with pytest.raises(OSError, match="refused"):
            other.connect((address, served.port))


def test_a_path_leads_to_no_file(served):
    for path in ("/../../etc/passwd", "/static/../../../../etc/passwd", "/..%2f..%2fetc/passwd"):
        status, text = ask(served, f"/{served.token}{path}")
        assert status in (403, 404)
        assert "root:" not in text


def test_a_missing_extra_says_which_line_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "panel", None)
    assert 'pip install "foamfit[page]"' in run_refused("page")


def test_a_wrong_call_is_refused(served, tmp_path):
    assert "no such file" in run_refused("page", tmp_path / "none.csv")
    told = run_refused("page", "--no-browser", "--port", served.port)
    assert f"--port {served.port} cannot be used" in told
