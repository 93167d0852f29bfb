"""How often the kernel has killed a process of this control group, in both versions and inside containers."""

import pytest

from catstream.base import cgroup


@pytest.mark.parametrize(
    ("group", "file", "content"),
    [
        ("0::/app", "app/memory.events", "low 0\nhigh 3\noom 4\noom_kill 2\noom_group_kill 0\n"),
        ("0::/of/the/host", "memory.events", "oom 4\noom_kill 2\n"),
        (
            "1:cpu:/app\n4:misc,memory:/app\n0::/",
            "memory/app/memory.oom_control",
            "oom_kill_disable 0\noom_kill 2\n",
        ),
        ("4:memory:/of/the/host\n0::/", "memory/memory.oom_control", "oom_kill_disable 0\nunder_oom 0\noom_kill 2\n"),
    ],
    ids=["version 2", "version 2, container", "version 1", "version 1, container"],
)
def test_kills_for_want_of_memory_are_counted_wherever_the_group_is(monkeypatch, tmp_path, group, file, content):
    monkeypatch.setattr(cgroup, "_GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(cgroup, "_MOUNT", tmp_path / "mount")
    assert cgroup.oom_kills() == 0, "there is no /proc"
    (tmp_path / "cgroup").write_text(f"{group}\n")
    assert cgroup.oom_kills() == 0, "the group has no counter"
    (tmp_path / "mount" / file).parent.mkdir(parents=True)
    (tmp_path / "mount" / file).write_text("oom_kill_disable 0\n")
    assert cgroup.oom_kills() == 0, "an older kernel does not count"
    (tmp_path / "mount" / file).write_text(content)
    assert cgroup.oom_kills() == 2
