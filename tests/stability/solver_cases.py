"""Hard cases of the solver, from all files."""

from __future__ import annotations

import corner_cases
import law_cases
import soil_cases
import step_cases
import tool_cases

CASES = [
    *corner_cases.CASES,
    *step_cases.CASES,
    *soil_cases.CASES,
    *tool_cases.CASES,
    *law_cases.CASES,
]
