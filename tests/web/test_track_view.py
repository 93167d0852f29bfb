"""`catstream track --view`: the page of a run, and its first box."""

from __future__ import annotations

import subprocess
import sys

import httpx


def test_the_first_box_comes_from_the_page_and_the_run_goes_on_to_its_end(demo_video, folder, tmp_path, until):
    source, boxes = demo_video(40)
    words = ["track", source, "--view", "0", "--output", tmp_path / "out", "--set", f"endpoint={folder}"]
    with (
        subprocess.Popen(
            [sys.executable, "-c", "from catstream.cli import main; main()", *map(str, words)],
            stderr=subprocess.PIPE,
            text=True,
        ) as run,
        httpx.Client(timeout=60, verify=False) as browser,
    ):
        said = run.stderr.readline()
        assert said.startswith("page: http://127.0.0.1:")
        url = said.split()[1]
        until(lambda: browser.get(f"{url}readyz").status_code == 200)
        command = {"verb": "set-box", "box": list(boxes[0])}
        answer = until(lambda: browser.post(f"{url}control", json=command))
        assert answer.json()["done"], answer.text
        run.communicate(timeout=120)
    assert run.returncode == 0
    assert len((tmp_path / "out" / "demo.txt").read_text().splitlines()) == 40
