"""The command that serves the board."""

import os
import signal
import subprocess
import sys
import urllib.request

from shell import qfolio


def test_the_command_says_where_the_board_is_and_ends_with_ctrl_c(tmp_path):
    command = [sys.executable, "-m", "qfolio", "board", str(tmp_path), "--port", "0", "--no-open"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        try:
            assert process.stdout is not None
            said = process.stdout.readline()
            assert said.startswith(f"The board of {tmp_path} is at http://127.0.0.1:")
            with urllib.request.urlopen(said.split()[-1], timeout=60) as answer:
                assert b"<title>qfolio board</title>" in answer.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
        finally:
            process.kill()


def test_the_board_does_not_wait_for_numpy():
    served = "from qfolio.report.board import server; server._text('board.html')"
    code = f"import sys; {served}; print('numpy' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "False\n"


def test_a_folder_that_is_none_is_refused_in_a_sentence(monkeypatch, capsys, tmp_path):
    assert qfolio(monkeypatch, "board", tmp_path / "none", "--no-open") == 2
    assert "is not a folder; give the one that holds your runs" in capsys.readouterr().err
