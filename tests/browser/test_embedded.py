"""The viewer in a frame of a notebook. For the browser these are two sites, so the frame gets no cookie."""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

import hilsplat


@pytest.fixture
def notebook(tmp_path):
    """Serves tmp_path/notebook.html at http://localhost, which is another site than 127.0.0.1."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=tmp_path))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://localhost:{server.server_port}/notebook.html"
    server.shutdown()
    server.server_close()


def test_the_frame_in_a_notebook_answers_a_query(browser, desk, tmp_path, notebook):
    shown = hilsplat.show(desk, "mug > handle", height=420)
    try:
        (tmp_path / "notebook.html").write_text(
            f"<!doctype html><title>notebook</title><link rel=icon href=data:,>{shown._repr_html_()}"
        )
        context = browser.new_context(viewport={"width": 800, "height": 480}, reduced_motion="reduce")
        page, wrong = context.new_page(), []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda said: said.type == "error" and wrong.append(said.text))
        page.goto(notebook)
        frame = page.frame_locator("iframe")
        frame.locator("body[data-ready=yes]").wait_for()
        frame.get_by_role("status").get_by_text("1 answer").wait_for()
        assert not [said for said in wrong if "autofocus" not in said]
        context.close()
    finally:
        shown.close()
