"""Non-negative sparse codes, the kernel of the paper's sparse collaborative model."""

from __future__ import annotations

import numpy as np

from catstream.base.arrays import Float32, Float64
from catstream.features.compilation import kernel


@kernel("void(float64[:,::1], float64[:,::1], float32[:,::1])", nogil=True, fastmath=True, error_model="numpy")
def sparse_codes(gains: Float64, gram: Float64, codes: Float32) -> None:
    """Non-negative sparse codes, by active sets (Lawson and Hanson).

    The atom with the highest gain enters the active set; atoms whose code becomes negative leave it. The Gram matrix of
    the set is stored as a Cholesky factor with an inverted diagonal, with the solution of its forward substitution: an
    atom that enters adds one row to both. `gains` are the gains at code 0.
    """
    count = len(gram)
    code, solution, forward, gain = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    active, factor = np.empty(count, np.int64), np.empty((count, count))
    for row in range(len(codes)):
        start, size = gains[row], 0
        for atom in range(count):
            gain[atom] = start[atom]
        for _ in range(3 * count):
            # Step 1: the atom with the highest gain enters the active set.
            highest, best = gain[0], 0
            for atom in range(1, count):
                highest = max(highest, gain[atom])
            if highest <= 1e-6:
                break
            while gain[best] < highest:
                best += 1
            active[size], code[size] = best, 0.0
            valid, size = size, size + 1
            while size:
                # Step 2: extend the factor and the forward substitution by the new rows, and solve for the code.
                for i in range(valid, size):
                    alike = gram[active[i]]
                    for j in range(i):
                        total = alike[active[j]]
                        for k in range(j):
                            total -= factor[i, k] * factor[j, k]
                        factor[i, j] = total * factor[j, j]
                    total, rest = alike[active[i]], start[active[i]]
                    for k in range(i):
                        total -= factor[i, k] * factor[i, k]
                        rest -= factor[i, k] * forward[k]
                    factor[i, i] = 1 / np.sqrt(max(total, 1e-9))
                    forward[i] = rest * factor[i, i]
                for i in range(size):
                    solution[i] = forward[i]
                for i in range(size - 1, -1, -1):
                    solution[i] *= factor[i, i]
                    for k in range(i):
                        solution[k] -= factor[i, k] * solution[i]
                # Step 3: move towards the solution until a code becomes 0. That atom leaves the set; solve again.
                step, leaving = 1.0, -1
                for i in range(size):
                    if solution[i] <= 0:
                        share = code[i] / (code[i] - solution[i]) if code[i] > 0 else 0.0
                        if share < step:
                            step, leaving = share, i
                for i in range(size):
                    code[i] += step * (solution[i] - code[i])
                if leaving < 0:
                    break
                size -= 1
                for i in range(leaving, size):
                    active[i], code[i] = active[i + 1], code[i + 1]
                valid = leaving
            # Step 4: compute the gains of all atoms again.
            for atom in range(count):
                gain[atom] = start[atom]
            for i in range(size):
                weight, alike = code[i], gram[active[i]]
                for atom in range(count):
                    gain[atom] -= weight * alike[atom]
            for i in range(size):
                gain[active[i]] = 0
        for i in range(size):
            codes[row, active[i]] = code[i]
