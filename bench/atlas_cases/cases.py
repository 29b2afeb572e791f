"""All cases of the atlas, in the order of the table of hard cases."""

import re

from atlas_cases import cases_between, cases_derivatives, cases_motion, cases_rows

_ALL = (*cases_rows.CASES, *cases_motion.CASES, *cases_derivatives.CASES, *cases_between.CASES)
CASES = tuple(sorted(_ALL, key=lambda case: int(re.match(r"E(\d+)", case.name).group(1))))
