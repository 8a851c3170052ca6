import html
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from sgns.evaluate.figures import PICTURE_WIDTH
from sgns.evaluate.metrics import ParticleErrors, PositionErrors, VectorErrors
from sgns.evaluate.report import (
    FigureGroup,
    ReportFigure,
    describe,
    fixed,
    number,
    picture,
    render_report,
    short_names,
)
from sgns.evaluate.results import Costs, EvaluatedRun, Evaluation, FullSpaceCost, NetworkTiming, aggregate
from sgns.reduction.basis import Basis, ReductionCurves
from sgns_testing.pictures import SMALLEST_TEXT
from sgns_testing.surrogates import made_scores

EVIL = '<script>alert("run&1")</script>'


def scores(name, skill=0.9, force=0.3, mean=0.6, reduction=0.1):
    """Scores with a given skill, force NRMSE, NRMSE of the mean force and share of the reduction."""
    total = 1e-4 * (1.0 - skill)
    own, baseline = (made_scores(name, total, 1e-4, 1.0 + factor, 20.0) for factor in (force, mean))
    parts = {"reduction": reduction * total, "network": (1 - reduction) * total}
    mse = own.mse | parts | {"constant_velocity": 1e-4}
    return replace(own, mse=mse, mean_force=baseline.force, mean_torque=baseline.torque)


def evaluation(names=("run1", "run2"), split="test", rollout=0.1, words="", wheel=False, **kw):
    particles = ParticleErrors(np.full(5, 1e-6), np.full(5, 1e-7))
    errors = PositionErrors(np.arange(4) / 60.0, *[np.full(4, 1e-6)] * 7, particles)
    runs = [
        EvaluatedRun(n, n, words, Path("t.h5"), Path("p.h5"), errors, scores(n, **kw), wheel) for n in names
    ]
    return Evaluation(
        dataset="quick & <dirty>",
        split=split,
        runs=runs,
        total=aggregate([run.scores for run in runs]),
        timing=NetworkTiming(rollout, 2 * rollout, 3 * rollout, 10.0, 3, names[0]),
        mean_force=np.array([-90.0, 0.0, 40.0]),
        curves=ReductionCurves(np.ones(2), np.ones(2), np.ones(2), np.ones(3)),
        basis=Basis(torch.zeros(4, 3), torch.eye(4)[:, :2], torch.ones(2), 3.0, 3.0, "particle_axis"),
        num_modes=2,
        history=3,
        start=np.zeros((9600, 3)),
        made={"command": "sgns evaluate 'a<b'", "machine": "a CPU, 4 cores"},
    )


class Tags(HTMLParser):
    """Collects tags and attributes, and checks that they are closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.links, self.headings = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in ("src", "href", "action", "srcset")]
        self.headings += [value for key, value in attrs if tag == "h2" and key == "id"]
        if tag not in ("meta", "img", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def parsed(page):
    parser = Tags()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def group(data=b"", words="Words"):
    return FigureGroup(words, "training", [ReportFigure("a", words, words, data)], words)


def section(heading, result):
    """The HTML under a heading, its breaks of lines as blanks."""
    page = render_report(result, [])
    text = page.partition(f">{heading}</h2>")[2].partition("<h2")[0]
    return " ".join(text.split())


def summary(result):
    """The words of the first paragraph of the page."""
    text = render_report(result, []).partition("<p>")[2].partition("</p>")[0]
    return " ".join(html.unescape(text).split())


def test_pictures_can_be_read_on_a_desktop_and_opened_in_full():
    page = render_report(evaluation(), [group(b"\x89PNG")] * 3)
    assert page.count('<input type="checkbox" class="zoom"') == 3 == page.count("<label>")
    assert ".zoom:checked + img { position: fixed;" in page
    narrowest = 16 * float(re.search(r"minmax\(min\(([\d.]+)rem, 100%\)", page)[1])
    size = SMALLEST_TEXT * narrowest / (72 * PICTURE_WIDTH)  # [pixels of the page], of text in points
    assert size >= 9.0


def test_page_is_well_formed_and_needs_nothing_from_outside():
    page = render_report(evaluation(), [group(b"\x89PNG")])
    parser = parsed(page)
    pictures = [link for link in parser.links if not link.startswith("#")]
    assert pictures == ["data:image/png;base64,iVBORw=="]
    assert page.count('<img alt="Words"') == 1  # for those who do not see it
    assert not {"script", "link", "iframe", "object"} & set(parser.tags)
    assert not re.search(r"https?://|@import|url\(", page)
    anchors = [link[1:] for link in parser.links if link.startswith("#")]
    assert anchors == parser.headings and len(set(anchors)) == len(anchors) > 4


def test_everything_is_escaped():
    hostile = evaluation(names=(EVIL,))
    page = render_report(replace(hostile, trained_on=[EVIL]), [group(words=EVIL)])
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert "quick &amp; &lt;dirty&gt;" in page
    assert "a&lt;b" in page
    parsed(page)


def test_tables_have_every_run_and_all_of_them():
    page = render_report(evaluation(names=("alpha", "beta", "gamma")), [])
    for name in ("alpha", "beta", "gamma", "all runs"):
        assert page.count(f">{name}</td>") == 3  # soil, force and test examples
    assert page.count('<tr class="total">') == 3
    assert ">tool</th>" not in page  # nothing is to be said of the scenes
    assert render_report(evaluation(words="5 cm deep & slow"), []).count(">5 cm deep &amp; slow</td>") == 2


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"skill": 0.95}, "follows the motion of the soil closely"),
        ({"skill": 0.6}, "follows most of the motion of the soil. Its particles are off by"),
        ({"skill": 0.2}, "only roughly"),
        ({"skill": -0.5}, "does not predict the soil"),
        ({"force": 0.1}, ", clearly better than always answering"),
        ({"force": 0.5}, ", better than always answering"),
        ({"force": 0.58}, ", hardly better than always answering"),
        ({"force": 0.9}, ", no better than always answering"),
        ({"rollout": 0.1}, "In the same measurement the solver took 10 s, 100 times as long."),
        ({"rollout": 40.0}, "the solver took 10 s, 4.0 times less."),
        ({"names": ["one"]}, "of 1 run that it never saw, and predicted the rest."),
        ({"reduction": 0.7}, "Of the squared error 70 % is the subspace's, not the network's."),
    ],
)
def test_words_follow_from_the_numbers(numbers, words):
    text = summary(evaluation(**numbers))
    skill = numbers.get("skill", 0.9)
    assert words in text and f"(skill {fixed(skill)}, where" in text
    assert ("worse than letting every particle go on" in text) == (skill <= 0.0)
    assert ("is the subspace's" in text) == ("reduction" in numbers)


def test_words_about_a_tool_whose_place_is_predicted():
    result = evaluation(wheel=True)
    assert "was given the tool's path" in summary(result) and "from its place" not in summary(result)
    free = replace(result, total=replace(result.total, body_mse=4e-6, sinkage_mae=1.5e-3))
    assert "was given what is prescribed of the tool's motion" in summary(free)
    assert "is 2.00 mm (RMS) from its place; the sinkage is off by 1.50 mm" in summary(free)
    free = replace(result, total=replace(result.total, body_mse=4e-6))
    assert "from its place." in summary(free)


def test_nothing_that_moved_or_pushed_is_said():
    result = evaluation()
    still = replace(result.total, mse=dict.fromkeys(result.total.mse, 0.0))
    none = VectorErrors.compare(np.zeros((2, 3)), np.zeros((2, 3)))
    still = replace(still, force=none, mean_force=none, solver_rate=math.nan)
    text = summary(replace(result, total=still))
    assert "nothing moved" in text and "there was none" in text
    page = render_report(replace(result, total=still), [])
    parsed(page)
    untimed = replace(result, timing=replace(result.timing, solver=math.nan))
    assert "could not be timed" in summary(untimed)
    assert "speed beside the solver, which could not be timed" in render_report(untimed, [])
    assert "faster than the solver" in render_report(result, [])
    assert "slower than the solver" in render_report(evaluation(rollout=40.0), [])


def test_numbers_as_people_write_them():
    for value, text in (
        (0.0, "0.000"), (1234.5, "1230"), (3.14159, "3.14"), (-0.01234, "−0.0123"), (2e-7, "2.00e−07"),
        (math.nan, "–"), (math.inf, "∞"),
    ):  # fmt: skip
        assert number(value) == text
    assert number(22829.0, 2) == "23000"
    assert fixed(-1.255, 1, sign=True) == "−1.3" and fixed(2.0, 1, sign=True) == "+2.0"
    assert fixed(math.nan) == "–" and fixed(-1e-6) == "0.00"


def test_description_and_file_name():
    scene = {"depth": 0.05, "speed": 0.1, "rake": 3.8, "motion": "curved"}
    assert describe(scene) == "5 cm deep, 10 cm/s, rake 3.8°, curved motion"
    wheel = {"diameter": 0.15, "load": 100.0, "slip": 0.4, "friction_angle": 30.0, "gravity": 3.72}
    assert describe(wheel) == "15 cm wheel, 100 N, slip 40 %, friction angle 30°, gravity 3.72 m/s²"
    turned = wheel | {"slip_angle": 60.0, "load": [[0.0, 1.0], [1.0, 2.0]]}
    assert describe(turned).startswith("15 cm wheel, load over time, slip 40 %, slip angle 60°, friction")
    assert describe({"kind": "bed"}) == ""
    assert describe(scene | {"motion": "path"}) == "on a path of its own"
    assert picture("../a b/ü.h5", "", "", Figure()).name == "-a-b-h5"


def test_short_names_still_tell_runs_apart():
    assert short_names(["0012_rake-10.0_depth-0.05", "0013_rake-10.0"]) == ["0012", "0013"]
    assert short_names(["cut_a", "cut_b"]) == ["cut_a", "cut_b"]
    assert short_names(["_x"]) == ["_x"]


@pytest.mark.parametrize(
    ("seen", "told", "warning"),
    [
        ({}, "that it never saw", ""),
        ({"trained_on": ["run1"]}, "not all new to it", "1 of the 2 evaluated runs bear the names of runs that this "
         "checkpoint was trained on (run1): for those"),
        ({"trained_on": ["run1", "run2"]}, "so this is no test", "trained on (run1, …)"),
        ({"chosen_by": ["run1", "run2"]}, "chose its checkpoint", "2 of the 2 evaluated runs bear the names of "
         "validation runs that chose this checkpoint (run1, …)"),
    ],
)  # fmt: skip
def test_runs_seen_before_are_named_and_only_then(seen, told, warning):
    result = replace(evaluation(), **seen)
    page = render_report(result, [])
    assert told in summary(result) and warning in page
    assert ('class="warning"' in page) == bool(seen)


def test_table_of_examples_keeps_the_sign_of_a_run_and_not_of_the_mean():
    page = section("Test examples", evaluation(force=-0.25, mean=0.6, skill=0.5))
    assert page.count(">−25.0</td>") == 4  # draft and vertical of two runs
    assert page.count(">|25.0|</td>") == 2
    assert page.count(">+60.0</td>") == 4
    assert page.count(">0.500</td>") == 3  # total: 5e-5 m² in units of 1e-4 m²


def test_forces_of_wheels_have_their_own_names():
    blade, wheel = evaluation(), evaluation(wheel=True)
    examples, forces = section("Test examples", blade), section("Force on the tool", blade)
    assert ">draft</th>" in examples and ">drawbar pull</th>" not in examples
    assert "sinkage" not in forces and "misplaced" not in forces
    forces = section("Force on the tool", wheel)
    assert ">drawbar pull</th>" in forces and "sinkage" in forces
    moved = replace(blade.total, body_mse=4e-6)
    assert ">2.00</td>" in section("Force on the tool", replace(blade, total=moved))


def test_shared_headings_span_their_columns():
    page = section("Force on the tool", evaluation())
    spans = [int(span) for span in re.findall(r'colspan="(\d+)"', page)]
    assert sum(spans) == page.count("<th>") + page.count('<th class="text">')


def test_costs_that_are_not_known_are_not_made_up():
    page = section("Time and memory", evaluation())
    assert page.count(">–</td>") == 7  # training twice, parameters, checkpoint, memory three times
    assert ">57 600</td>" in page and ">6</td>" in page and ">28 800</td>" in page
    assert "no training.json" in page and "full space" not in page and "full_space=true" in page


def test_costs_that_are_known_are_told():
    costs, full = Costs(253_777, 5.4e6, 6000, 240.0, 32), FullSpaceCost(40_000, 2.5, 2, 27.0, 3e9)
    page = section("Time and memory", replace(evaluation(), costs=costs, full_space=full))
    assert ">0.0400</td>" in page and ">253 777</td>" in page and "6000 steps of 32 samples" in page
    assert "full space, untrained" in page and ">27.0</td>" in page and ">40 000</td>" in page
    assert "full_space=true" not in page
