import numpy as np
import pytest
from pictures import pixels
from tensorboard.summary.writer.record_writer import masked_crc32c
from torch.utils.tensorboard import SummaryWriter

from sgns.errors import UserError
from sgns.evaluation.training_curves import HIGHEST, LOWEST, read_log, training_figure


def test_log_is_read_as_it_was_written(tmp_path):
    with SummaryWriter(tmp_path / "tensorboard") as writer:
        for step in range(0, 300, 50):
            writer.add_scalar("loss/total", 2.0 ** (-step / 50), step)
            writer.add_scalar("samples_per_s", 1000.0, step)
        writer.add_scalar("skill/validation", 0.5, 250)
    log = read_log(tmp_path / "tensorboard")
    assert set(log) == {"loss/total", "skill/validation"}
    assert log["loss/total"][:, 0] == pytest.approx(np.arange(0, 300, 50))
    assert log["loss/total"][:, 1] == pytest.approx(2.0 ** -np.arange(6.0))
    pixels(training_figure(log))


def test_no_log_is_no_error(tmp_path):
    assert read_log(tmp_path / "tensorboard") == {}
    (tmp_path / "events.out.tfevents.1.x").write_bytes(b"cut short")
    assert read_log(tmp_path) == {}


@pytest.mark.parametrize("names", [["loss/total"], ["skill/validation"], ["force_nrmse/validation"]])
def test_part_of_a_log_can_be_drawn(names):
    pixels(training_figure({name: np.array([[1.0, 0.5], [2.0, 0.4]]) for name in names}))


def test_rollouts_that_ran_away_do_not_flatten_the_rest():
    log = {"skill/validation": np.array([[1.0, -1e9], [2.0, np.nan], [3.0, 0.9]])}
    low, high = training_figure(log).axes[1].get_ylim()
    assert LOWEST - 0.1 < low < LOWEST and 1.0 < high < HIGHEST


def test_a_file_that_is_no_log_is_one_line(tmp_path):
    record = b"\xff\xff\xff\x0f"  # no event
    length = len(record).to_bytes(8, "little")
    content = length + _masked(length) + record + _masked(record)
    (tmp_path / "events.out.tfevents.1.x").write_bytes(content)
    with pytest.raises(UserError, match="holds no log of TensorBoard") as caught:
        read_log(tmp_path)
    assert "\n" not in str(caught.value)


def _masked(data):
    return masked_crc32c(data).to_bytes(4, "little")


def test_names_of_losses_are_no_formulas():
    pixels(training_figure({r"loss/$\frac$ %_": np.array([[1.0, 0.5], [2.0, 0.4]])}))
