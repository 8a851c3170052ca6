"""Checkpoints that no bed can be stepped with are named and refused."""

import pytest
import torch

from sgns.config import UserError
from sgns.model.checkpoint import load_surrogate


def with_a_mesh(content) -> None:
    content["hyper_parameters"]["format_version"] = 1  # older ones are read
    content["hyper_parameters"]["scene"]["tool"] = {"shape": "mesh", "file": "/etc/passwd"}


def with_nan(content) -> None:
    name = next(name for name in content["state_dict"] if name.endswith("weight"))
    content["state_dict"][name][0] = float("nan")


def saying(key, value):
    return lambda content: content["hyper_parameters"].update({key: value})


def ranging(low, high):
    """Gives a quantity another range."""

    def spoil(content) -> None:
        known = content["hyper_parameters"]["training_range"]
        known["low"]["the tool's position"], known["high"]["the tool's position"] = low, high

    return spoil


@pytest.mark.parametrize(
    ("line", "spoil"),
    [
        ("not a checkpoint of sgns", saying("format", None)),
        ("not a checkpoint of sgns", lambda content: content.pop("state_dict")),
        ("newer", saying("format_version", 99)),
        ("names a mesh file without the digest", with_a_mesh),
        ("fit together", lambda content: content["state_dict"].pop("surrogate.basis_modes")),
        ("not finite", with_nan),
        *[("frame rate is", saying("frame_rate", rate)) for rate in (float("inf"), float("nan"), 0.0, -60.0)],
        ("the slowest travel is nan", saying("slowest_travel", float("nan"))),
        ("fit together", saying("slowest_travel", None)),
        *[("fit together", saying("training_range", bad)) for bad in (None, {"low": {}, "high": {}}, [1])],
        ("ends differ", ranging([0.0], [1.0, 2.0])),
        *[
            ("not one of numbers in order", ranging(*ends))
            for ends in (([1.0], [0.0]), ([float("nan")], [0.0]), ([], []), (1.0, 2.0))
        ],
    ],
)
def test_what_is_wrong_with_it_is_said(trained_briefly, tmp_path, line, spoil) -> None:
    content = torch.load(trained_briefly.output / "best.ckpt", weights_only=True)
    spoil(content)
    torch.save(content, tmp_path / "bad.ckpt")
    with pytest.raises(UserError, match=line):
        load_surrogate(tmp_path / "bad.ckpt")


def test_a_folder_with_a_checkpoint_is_told_which_file_to_name(tmp_path) -> None:
    (tmp_path / "best.ckpt").touch()
    with pytest.raises(UserError, match=r"is a folder; use checkpoint=.*best\.ckpt"):
        load_surrogate(tmp_path)
