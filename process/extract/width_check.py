"""Whether the width of a row's fit is one that the stripe has there: what its neighbours say.

Where several samples of the stripe itself are hit, those that are left may look like a narrower or
wider one in another place, and nothing in the row tells.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..compiled import part
from .moments import DONE, REST, WIDTH

Floats = npt.NDArray[np.float64]

#: Rows looked at on either side, and how many of them must be sure.
_NEAR, _LEAST = 4, 3
#: A width this far beyond all of theirs is not believed of a fit that is poor.
_FACTOR = 1.18


@part
def width_is_odd(
    found: Floats, state: npt.NDArray[np.uint8], row: int, width: float, odd: float
) -> bool:
    """Whether ``width`` is far from those of the rows beside ``row`` that were solved as a Gaussian.

    ``found`` and ``state`` as in moments.py; remainders above ``odd`` are not sure.
    """
    low, high, n = np.inf, 0.0, 0
    for other in range(max(0, row - _NEAR), min(len(state), row + _NEAR + 1)):
        if other != row and state[other] == DONE and found[REST, other] <= odd:
            low = min(low, found[WIDTH, other])
            high = max(high, found[WIDTH, other])
            n += 1
    return n >= _LEAST and (width * _FACTOR < low or width > _FACTOR * high)
