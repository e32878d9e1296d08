"""A replay buffer on disk."""

import os
import pickle

import numpy as np
import pytest
from gymnasium import spaces
from resume_helpers import difference
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from sb3_symphony.common.buffers import SumTree
from sb3_symphony.common.replay_files import ReplaySegments

BOX = spaces.Box(-1.0, 1.0, (3,))
DICT = spaces.Dict({"a": BOX, "b": spaces.Box(0, 255, (2, 2), np.uint8)})


def filled(class_, space, size, n_envs, **kwargs):
    buffer = class_(size * n_envs, space, BOX, device="cpu", n_envs=n_envs, **kwargs)
    rng = np.random.default_rng(0)

    def observation():
        one = {key: rng.uniform(0, 99, (n_envs, *s.shape)) for key, s in (DICT if space is DICT else {"": BOX}).items()}
        return one if space is DICT else one[""]

    def add(n):
        for _ in range(n):
            done = rng.random(n_envs) < 0.2
            infos = [{"TimeLimit.truncated": bool(truncated)} for truncated in done & (rng.random(n_envs) < 0.5)]
            buffer.add(observation(), observation(), rng.uniform(-1, 1, (n_envs, 3)), rng.normal(size=n_envs), done, infos)

    return buffer, add


@pytest.mark.parametrize("small", [0, 10**3, 10**6])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("class_, space", [(ReplayBuffer, BOX), (NStepReplayBuffer, BOX), (DictReplayBuffer, DICT)])
def test_segments_hold_the_buffer(tmp_path, monkeypatch, class_, space, n_envs, small):
    """Whatever is added between two savings: nothing, a bit, to the end of the ring and around it, all of it and more."""
    monkeypatch.setattr(ReplaySegments, "small", small)
    kwargs = {"n_steps": 3, "gamma": 0.9} if class_ is NStepReplayBuffer else {}
    buffer, add = filled(class_, space, 20, n_envs, **kwargs)
    segments, rows, needed = ReplaySegments(tmp_path), 0, []
    for new in (0, 1, 7, 0, 12, 1, 5, 20, 3, 47, 19):
        add(new)
        rows += new
        needed = segments.save(buffer, rows)
        copy, _ = filled(class_, space, 20, n_envs, **kwargs)
        ReplaySegments(tmp_path, needed).load(copy)
        n = buffer.size()
        for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
            a, b = getattr(buffer, name), getattr(copy, name)
            a, b = ({k: v[:n] for k, v in x.items()} if isinstance(x, dict) else x[:n] for x in (a, b))
            assert difference(a, b) is None
    if small != 10**3:
        assert len(needed) == (1 if small else 2)  # 19 rows and what is left of 20


def test_frequent_checkpoints_do_not_leave_many_files(tmp_path, monkeypatch):
    monkeypatch.setattr(ReplaySegments, "small", 2000)
    buffer, add = filled(ReplayBuffer, BOX, 1000, 1)  # 48 bytes per row: 41 rows in 2000 bytes
    segments, fsync = ReplaySegments(tmp_path), os.fsync
    for row in range(1, 301):
        add(1)
        if row % 7 == 0:  # a failure in between loses nothing
            monkeypatch.setattr(os, "fsync", lambda descriptor: (_ for _ in ()).throw(OSError("full")))
            with pytest.raises(OSError, match="full"):
                segments.save(buffer, row)
            monkeypatch.setattr(os, "fsync", fsync)
        needed = segments.save(buffer, row)
    assert len(needed) <= 300 // 41 + 1
    copy, _ = filled(ReplayBuffer, BOX, 1000, 1)
    ReplaySegments(tmp_path, needed).load(copy)
    assert difference(copy.observations[:300], buffer.observations[:300]) is None


def test_a_segment_holds_only_what_is_new(tmp_path, monkeypatch):
    monkeypatch.setattr(ReplaySegments, "small", 0)
    buffer, add = filled(ReplayBuffer, BOX, 5000, 1)
    segments, rows, sizes = ReplaySegments(tmp_path), 0, []
    for new in (1000, 100, 100, 2000, 100):
        add(new)
        rows += new
        sizes.append((tmp_path / segments.save(buffer, rows)[-1].file).stat().st_size)
    assert sizes[1] == pytest.approx(sizes[2], rel=0.01) == pytest.approx(sizes[4], rel=0.01)
    assert sizes[0] > 7 * sizes[1] and sizes[3] > 14 * sizes[1]


def test_sum_tree_is_pickled_without_what_is_empty():
    for n_leaves, n_used in ((1, 0), (1, 1), (5, 3), (1000, 400), (1024, 1024)):
        tree, rng = SumTree(n_leaves), np.random.default_rng(0)
        for _ in range(20):
            if n_used:
                leaves = rng.integers(0, n_used, 50)
                tree.set(leaves, rng.random(50))
        copy = pickle.loads(pickle.dumps(tree))
        assert vars(copy).keys() == vars(tree).keys()
        assert copy.nodes.tobytes() == tree.nodes.tobytes() and copy.n_leaves == tree.n_leaves
    assert len(pickle.dumps(SumTree(10**6))) < 300
