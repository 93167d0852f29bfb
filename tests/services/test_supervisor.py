"""The log of a process, as its supervisor reads it."""

from contextlib import closing

from catstream.services.supervisor import ProcessLog


def test_new_lines_are_those_of_the_process_itself_and_a_line_without_an_end_waits(tmp_path):
    with (tmp_path / "log").open("w+b") as file, closing(ProcessLog("detector", file)) as log:
        assert log.last_line() == "it logged nothing"
        file.write(b"detector: one\nTraceback\ndetector: tw")
        file.flush()
        assert log.new_lines() == ["one"]
        file.write(b"o\n")
        file.flush()
        assert log.new_lines() == ["two"]
        assert log.last_line() == "two"


def test_a_line_that_is_longer_than_what_is_read_at_once_does_not_hide_the_next_one(tmp_path):
    with (tmp_path / "log").open("w+b") as file, closing(ProcessLog("detector", file)) as log:
        file.write(b"detector: " + bytes(200_000) + b"\ndetector: the source is lost\n")
        file.flush()
        assert [line for _ in range(9) for line in log.new_lines()] == ["the source is lost"]
