import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from sgns.evaluation.metrics import PositionErrors, VectorErrors
from sgns.evaluation.report import render_report
from sgns.evaluation.report_figures import ReportFigure, file_name
from sgns.evaluation.report_words import describe, fixed, number, short_names, summary, titled
from sgns.evaluation.results import EvaluatedRun, Evaluation, NetworkTiming
from sgns.evaluation.scores import Scores, aggregate
from sgns.reduction.reconstruction import ReductionCurves

EVIL = '<script>alert("run&1")</script>'


def scores(name, skill=0.9, force=0.3, mean=0.6, reduction=0.1):
    """Scores with a given skill, force NRMSE, NRMSE of the mean force and share of the reduction."""
    truth = np.full((4, 3), [-100.0, 0.0, 50.0])
    total = 1e-4 * (1.0 - skill)
    mse = {
        "reduction": reduction * total,
        "network": (1 - reduction) * total,
        "total": total,
        "frozen": 1e-4,
        "constant_velocity": 1e-4,
        "surface": 1e-6,
        "surface_frozen": 1e-5,
    }
    own = VectorErrors.compare(truth, (1 + force) * truth)
    baseline = VectorErrors.compare(truth, (1 + mean) * truth)
    mpe = {"draft": 100 * force, "lateral": math.nan, "vertical": 100 * force}
    return Scores(name, 4, mse, own, own, baseline, baseline, 20.0, mpe)


def evaluation(names=("run1", "run2"), split="test", stepping=0.1, words="", **kw):
    errors = PositionErrors(np.arange(4) / 60.0, *[np.full(4, 1e-6)] * 7)
    runs = [EvaluatedRun(n, n, words, Path("t.h5"), Path("p.h5"), errors, scores(n, **kw)) for n in names]
    return Evaluation(
        dataset="quick & <dirty>",
        split=split,
        runs=runs,
        total=aggregate([run.scores for run in runs]),
        timing=NetworkTiming(stepping, 2 * stepping, 3, names[0]),
        mean_force=np.array([-90.0, 0.0, 40.0]),
        curves=ReductionCurves(np.ones(2), np.ones(2), np.ones(2), np.ones(3)),
        num_modes=2,
        history=3,
        particle_count=9600,
        start=np.zeros((9600, 3)),
        made={"command": "sgns evaluate 'a<b'", "machine": "a CPU, 4 cores"},
    )


class Tags(HTMLParser):
    """Collects tags and attributes, and checks that they are closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.links = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in ("src", "href", "action", "srcset")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def parsed(page):
    parser = Tags()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def test_page_is_well_formed_and_needs_nothing_from_outside():
    figure = ReportFigure("a", "Group", "Title", "Caption", b"\x89PNG")
    page = render_report(evaluation(), [figure])
    parser = parsed(page)
    assert parser.links == ["data:image/png;base64,iVBORw=="]
    assert not {"script", "link", "iframe", "object"} & set(parser.tags)
    assert not re.search(r"https?://|@import|url\(", page)


def test_everything_is_escaped():
    hostile = evaluation(names=(EVIL,))
    figure = ReportFigure("a", EVIL, EVIL, EVIL, b"")
    page = render_report(hostile, [figure])
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert "quick &amp; &lt;dirty&gt;" in page
    assert "a&lt;b" in page
    parsed(page)


def test_table_has_every_run_and_all_of_them():
    page = render_report(evaluation(names=("alpha", "beta", "gamma")), [])
    for name in ("alpha", "beta", "gamma", "all runs"):
        assert page.count(f">{name}</td>") == 2  # soil and force
    assert page.count('<tr class="total">') == 2


@pytest.mark.parametrize(
    ("skill", "words"),
    [
        (0.95, "follows the motion of the soil closely"),
        (0.6, "follows most of the motion"),
        (0.2, "only roughly"),
        (-0.5, "does not predict the soil"),
    ],
)
def test_words_follow_from_the_skill(skill, words):
    text = summary(evaluation(skill=skill))
    assert words in text
    assert fixed(skill) in text
    assert ("worse than letting every particle go on" in text) == (skill <= 0.0)


@pytest.mark.parametrize(
    ("force", "words"),
    [
        (0.1, "clearly better than"),
        (0.5, "better than"),
        (0.58, "hardly better than"),
        (0.9, "no better than"),
    ],
)
def test_words_follow_from_the_force(force, words):
    assert f", {words} always answering" in summary(evaluation(force=force))


def test_words_about_time_and_split():
    assert "200 times less" in summary(evaluation(stepping=0.1))
    assert "2.0 times more" in summary(evaluation(stepping=40.0))
    assert "slower than the solver" in render_report(evaluation(stepping=40.0), [])
    assert "never saw" in summary(evaluation())
    assert "no test" in summary(evaluation(split="train"))
    assert "1 run that" in summary(evaluation(names=("one",)))


def test_words_name_the_subspace_where_it_is_to_blame():
    assert "is the subspace's" in summary(evaluation(reduction=0.7))
    assert "is the subspace's" not in summary(evaluation(reduction=0.2))


def test_nothing_that_moved_or_pushed_is_said():
    result = evaluation()
    still = replace(result.total, mse=dict.fromkeys(result.total.mse, 0.0))
    none = VectorErrors.compare(np.zeros((2, 3)), np.zeros((2, 3)))
    still = replace(still, force=none, mean_force=none, solver_rate=math.nan)
    text = summary(replace(result, total=still))
    assert "nothing moved" in text and "there was none" in text and "not recorded" in text
    parsed(render_report(replace(result, total=still), []))


def test_numbers_as_people_write_them():
    assert [number(v) for v in (0.0, 1234.5, 3.14159, -0.01234, 2e-7)] == [
        "0.000",
        "1230",
        "3.14",
        "−0.0123",
        "2.00e−07",
    ]
    assert number(math.nan) == "–" and number(math.inf) == "∞"
    assert number(22829.0, 2) == "23000"
    assert fixed(-1.255, 1, sign=True) == "−1.3" and fixed(2.0, 1, sign=True) == "+2.0"
    assert fixed(math.nan) == "–" and fixed(-1e-6) == "0.00"


def test_description_and_file_name():
    scene = {"depth": 0.05, "speed": 0.1, "rake": 3.8, "motion": "curved"}
    assert describe(scene) == "5 cm deep, 10 cm/s, rake 3.8°, curved motion"
    assert describe({"kind": "bed"}) == ""
    assert titled("run", scene) == f"run: {describe(scene)}" and titled("run", {}) == "run"
    assert file_name("../a b/ü.h5") == "-a-b-h5"


def test_short_names_still_tell_runs_apart():
    assert short_names(["0012_rake-10.0_depth-0.05", "0013_rake-10.0"]) == ["0012", "0013"]
    assert short_names(["cut_a", "cut_b"]) == ["cut_a", "cut_b"]
    assert short_names(["_x"]) == ["_x"]


def test_scene_of_every_run_is_told():
    assert ">tool</th>" not in render_report(evaluation(), [])
    assert render_report(evaluation(words="5 cm deep & slow"), []).count(">5 cm deep &amp; slow</td>") == 2
