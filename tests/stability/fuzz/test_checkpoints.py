"""Checkpoints."""

from __future__ import annotations

import zipfile
from typing import Any

import hypothesis.strategies as st
import pytest
import torch
from hydra import compose, initialize_config_module
from hypothesis import given

from sgns.config import UserError
from sgns.model.checkpoint import load_surrogate
from sgns_testing.commands import SMALL
from sgns_testing.fuzzing import cases, changed, damaged, refused_or_read


def test_checkpoints(good, tmp_path) -> None:
    whole = torch.load(good / "out" / "best.ckpt", weights_only=True)
    card, state = whole["hyper_parameters"], whole["state_dict"]
    path = tmp_path / "a.ckpt"
    with initialize_config_module("sgns.conf", version_base="1.3"):
        cfg = compose("rollout", [*SMALL, f"checkpoint={path}", f"output={tmp_path / 'rollout.h5'}"])

    def play() -> None:
        from sgns.rollout import main

        main(cfg)

    @cases(15)
    @given(changed(card))
    def other_card(changed_card: Any) -> None:
        torch.save({"state_dict": state, "hyper_parameters": changed_card}, path)
        refused_or_read(play)

    @cases(8)
    @given(
        st.sampled_from(sorted(state)),
        st.sampled_from(["missing", "huge", "shape", "type", "nan", "sparse", "none"]),
    )
    def other_state(name: str, kind: str) -> None:
        value = state[name]
        changes = {
            "huge": torch.zeros(1).expand(10**12),
            "shape": torch.zeros(*value.shape, 2),
            "type": torch.zeros(value.shape, dtype=torch.int8),
            "nan": torch.full_like(value, torch.nan),
            "sparse": torch.zeros(value.shape).to_sparse(),
            "none": None,
        }
        tensors = {k: v for k, v in state.items() if k != name}
        if kind != "missing":
            tensors[name] = changes[kind]
        torch.save({"state_dict": tensors, "hyper_parameters": card}, path)
        refused_or_read(play)

    @cases(8)
    @given(damaged((good / "out" / "best.ckpt").read_bytes()))
    def damage(content: bytes) -> None:
        path.write_bytes(content)
        refused_or_read(lambda: load_surrogate(path))

    other_card()
    other_state()
    damage()


def test_archives_that_claim_more_than_they_hold(good, tmp_path) -> None:
    with zipfile.ZipFile(good / "out" / "best.ckpt") as old, zipfile.ZipFile(tmp_path / "a.ckpt", "w") as new:
        for part in old.infolist():
            new.writestr(part.filename, old.read(part), compress_type=zipfile.ZIP_DEFLATED)
    with pytest.raises(UserError, match="cannot be read as a checkpoint"):
        load_surrogate(tmp_path / "a.ckpt")
