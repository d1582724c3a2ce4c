"""Kernels of the geometric polish: Sampson distances, their normal equations, steps on matrices of rank 2.

A match is a row (x, y, x', y') of coordinates that were moved and scaled by one factor for both images, so that a
distance is that in pixels times the factor. A matrix of rank 2 is F = cos(a) u0 v0^T + sin(a) u1 v1^T, with u and v the
columns of two orthogonal matrices U and V: the orthonormal representation of Bartoli and Sturm (2004), "Non-linear
estimation of the fundamental matrix with minimal parameters". Its seven parameters are small rotations of U and of V
and a change of the angle; rank 2 is never left and the scale is fixed.

`frame`, shape (19,), holds U, V (row by row) and a.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

#: Damping of the first step, as a part of the diagonal; what a taken step divides it by, a refused one multiplies.
_DAMPING, _EASIER, _HARDER = 1e-4, 8.0, 16.0

#: A direction that the matches say nothing of is damped by this part of the largest of the diagonal.
_FLOOR = 1e-12

#: Where the second singular value is less than about this part of the first, the rank counts as one.
_RANK_ONE = 1e-12

#: Annealing: the width shrinks by this factor down to so many limits, with so many steps at each width and at the last.
_SHRINKING, NARROWEST, _STEPS, _LAST_STEPS = 0.6, 2.0, 2, 6

#: A descent ends where a step gains less than this part of the loss.
_TOLERANCE = 1e-4


@kernel
def _cross(a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64]) -> float:
    """Write the cross product of a and b, shape (3,), and return its square."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    square: float = out[0] * out[0] + out[1] * out[1] + out[2] * out[2]
    return square


@kernel
def _normal_of(rows: NDArray[np.float64], normal: NDArray[np.float64]) -> bool:
    """Write a unit vector orthogonal to three vectors of a plane, the rows; False where they hold no plane."""
    trial = np.empty(3)
    largest, sizes = 0.0, 0.0
    for i in range(3):
        first, second = rows[i], rows[(i + 1) % 3]
        sizes = max(sizes, first[0] * first[0] + first[1] * first[1] + first[2] * first[2])
        square = _cross(first, second, trial)
        if square > largest:
            largest = square
            normal[:] = trial
    if not largest > (_RANK_ONE * sizes) ** 2:
        return False
    length = sqrt(largest)
    for i in range(3):
        normal[i] /= length
    return True


@kernel
def frame_of(f: NDArray[np.float64], frame: NDArray[np.float64]) -> bool:
    """Write the frame of a matrix of rank 2, f of shape (9,) and any scale; False where its rank is less."""
    F, U, V = f.reshape(3, 3), frame[:9].reshape(3, 3), frame[9:18].reshape(3, 3)
    u, v, w, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            turned[i, j] = F[j, i]
    if not (_normal_of(F, v[2]) and _normal_of(turned, u[2])):
        return False
    least = 0
    for i in range(1, 3):
        if abs(v[2, i]) < abs(v[2, least]):
            least = i
    w[:] = 0.0
    w[least] = 1.0
    length = sqrt(_cross(v[2], w, v[0]))
    for i in range(3):
        v[0, i] /= length
    _cross(v[2], v[0], v[1])
    # One rotation within the plane of v0 and v1 makes F v0 and F v1 orthogonal: the singular vectors.
    aa, ab, bb = 0.0, 0.0, 0.0
    for i in range(3):
        a, b = 0.0, 0.0
        for j in range(3):
            a += F[i, j] * v[0, j]
            b += F[i, j] * v[1, j]
        aa += a * a
        ab += a * b
        bb += b * b
    angle = 0.5 * atan2(2.0 * ab, aa - bb)
    c, s = cos(angle), sin(angle)
    for j in range(3):
        v[0, j], v[1, j] = c * v[0, j] + s * v[1, j], c * v[1, j] - s * v[0, j]
    for i in range(3):
        u[0, i] = F[i, 0] * v[0, 0] + F[i, 1] * v[0, 1] + F[i, 2] * v[0, 2]
    # In a matrix of nearly rank 1 its normal u2 is known badly, and u0, known well, must not lean towards it.
    lean = u[0, 0] * u[2, 0] + u[0, 1] * u[2, 1] + u[0, 2] * u[2, 2]
    long, short = 0.0, 0.0
    for i in range(3):
        u[0, i] -= lean * u[2, i]
        long += u[0, i] * u[0, i]
    long = sqrt(long)
    for i in range(3):
        u[0, i] /= long
    _cross(u[2], u[0], u[1])
    for i in range(3):
        short += u[1, i] * (F[i, 0] * v[1, 0] + F[i, 1] * v[1, 1] + F[i, 2] * v[1, 2])
    for i in range(3):
        for k in range(3):
            U[i, k] = u[k, i]
            V[i, k] = v[k, i]
    frame[18] = atan2(short, long)
    return True


@kernel
def matrix_of(frame: NDArray[np.float64], f: NDArray[np.float64]) -> None:
    """Write the matrix of a frame into f, shape (9,), row by row."""
    c, s = cos(frame[18]), sin(frame[18])
    for i in range(3):
        for j in range(3):
            f[3 * i + j] = c * frame[3 * i] * frame[9 + 3 * j] + s * frame[3 * i + 1] * frame[9 + 3 * j + 1]


@kernel
def tangent_of(frame: NDArray[np.float64], M: NDArray[np.float64]) -> None:
    """Write into M, shape (9, 7), the derivatives of the matrix by the rotations of U, of V, and the angle."""
    c, s = cos(frame[18]), sin(frame[18])
    for i in range(3):
        u0, u1, u2 = frame[3 * i], frame[3 * i + 1], frame[3 * i + 2]
        for j in range(3):
            v0, v1, v2 = frame[9 + 3 * j], frame[9 + 3 * j + 1], frame[9 + 3 * j + 2]
            row = 3 * i + j
            M[row, 0] = s * u2 * v1
            M[row, 1] = -c * u2 * v0
            M[row, 2] = c * u1 * v0 - s * u0 * v1
            M[row, 3] = s * u1 * v2
            M[row, 4] = -c * u0 * v2
            M[row, 5] = c * u0 * v1 - s * u1 * v0
            M[row, 6] = c * u1 * v1 - s * u0 * v0


@kernel
def _turn(frame: NDArray[np.float64], first: int, x: float, y: float, z: float) -> None:
    """Multiply the orthogonal matrix at `first` by the rotation of Cayley with the vector (x, y, z), from the right."""
    a, b, c = 0.5 * x, 0.5 * y, 0.5 * z
    n = 1.0 / (1.0 + a * a + b * b + c * c)
    for i in range(3):
        p, q, r = frame[first + 3 * i], frame[first + 3 * i + 1], frame[first + 3 * i + 2]
        frame[first + 3 * i] = n * (p * (1.0 + a * a - b * b - c * c) + q * 2.0 * (a * b + c) + r * 2.0 * (a * c - b))
        frame[first + 3 * i + 1] = n * (
            p * 2.0 * (a * b - c) + q * (1.0 - a * a + b * b - c * c) + r * 2.0 * (b * c + a)
        )
        frame[first + 3 * i + 2] = n * (
            p * 2.0 * (a * c + b) + q * 2.0 * (b * c - a) + r * (1.0 - a * a - b * b + c * c)
        )


@kernel
def stepped(frame: NDArray[np.float64], step: NDArray[np.float64], moved: NDArray[np.float64]) -> None:
    """Write into `moved` the frame after a step, shape (7,): to first order, `tangent_of` times the step is added."""
    for k in range(19):
        moved[k] = frame[k]
    _turn(moved, 0, step[0], step[1], step[2])
    _turn(moved, 9, step[3], step[4], step[5])
    moved[18] = frame[18] + step[6]


@kernel
def score(matches: NDArray[np.float64], f: NDArray[np.float64], limit: float) -> tuple[int, float]:
    """Return how many matches are within the limit, and the sum of ``min(r^2 / limit^2, 1)``."""
    most = limit * limit
    n = matches.shape[1]
    count, loss = 0, 0.0
    for i in range(n):
        x, y, u, v = matches[0, i], matches[1, i], matches[2, i], matches[3, i]
        a0, a1, a2 = f[0] * x + f[1] * y + f[2], f[3] * x + f[4] * y + f[5], f[6] * x + f[7] * y + f[8]
        b0, b1 = f[0] * u + f[3] * v + f[6], f[1] * u + f[4] * v + f[7]
        error = u * a0 + v * a1 + a2
        steep = a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1
        if error * error <= most * steep:
            count += 1
            if steep > 0.0:
                loss += error * error / steep
    return count, loss / most + (n - count)


@kernel
def normal_equations(
    matches: NDArray[np.float64],
    chosen: NDArray[np.int64],
    n_chosen: int,
    f: NDArray[np.float64],
    width: float,
    H: NDArray[np.float64],
    g: NDArray[np.float64],
) -> float:
    """Return Tukey's biweight loss of the first `n_chosen` of the chosen matches; write its equations by the entries.

    The loss of a distance r is ``(1 - (1 - (r / width)^2)^3) / 3`` up to the width, and 1/3 beyond. Into H, shape
    (9, 9), lower triangle, goes ``sum(w J J^T)`` and into g, shape (9,), ``sum(w r J)``, with J the derivative of the
    signed distance by the nine entries of f and w = (1 - (r / width)^2)^2.
    """
    j = np.empty(9)
    for a in range(9):
        g[a] = 0.0
        for b in range(9):
            H[a, b] = 0.0
    factor = 1.0 / (width * width)
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    loss = 0.0
    for k in range(n_chosen):
        i = chosen[k]
        x, y, u, v = matches[0, i], matches[1, i], matches[2, i], matches[3, i]
        a0, a1, a2 = f0 * x + f1 * y + f2, f3 * x + f4 * y + f5, f6 * x + f7 * y + f8
        b0, b1 = f0 * u + f3 * v + f6, f1 * u + f4 * v + f7
        error = u * a0 + v * a1 + a2
        steep = a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1
        if not steep > 0.0:
            continue
        ratio = error * error / steep * factor
        if ratio >= 1.0:
            loss += 1.0
            continue
        inside = 1.0 - ratio
        loss += 1.0 - inside * inside * inside
        q = error / steep
        j[0] = u * x - q * (a0 * x + b0 * u)
        j[1] = u * y - q * (a0 * y + b1 * u)
        j[2] = u - q * a0
        j[3] = v * x - q * (a1 * x + b0 * v)
        j[4] = v * y - q * (a1 * y + b1 * v)
        j[5] = v - q * a1
        j[6] = x - q * b0
        j[7] = y - q * b1
        j[8] = 1.0
        w = inside * inside / steep
        for a in range(9):
            wj = w * j[a]
            g[a] += wj * error
            for b in range(a + 1):
                H[a, b] += wj * j[b]
    return loss / 3.0


@kernel
def _solve(A: NDArray[np.float64], b: NDArray[np.float64], L: NDArray[np.float64], x: NDArray[np.float64]) -> bool:
    """Solve A x = b of seven unknowns by Cholesky, lower triangle; False where A is not positive definite."""
    for i in range(7):
        for k in range(i + 1):
            value = A[i, k]
            for m in range(k):
                value -= L[i, m] * L[k, m]
            if i == k:
                if not value > 0.0:
                    return False
                L[i, i] = sqrt(value)
            else:
                L[i, k] = value / L[k, k]
    for i in range(7):
        value = b[i]
        for m in range(i):
            value -= L[i, m] * x[m]
        x[i] = value / L[i, i]
    for i in range(6, -1, -1):
        value = x[i]
        for m in range(i + 1, 7):
            value -= L[m, i] * x[m]
        x[i] = value / L[i, i]
    return True


@kernel
def reduced(
    frame: NDArray[np.float64],
    H: NDArray[np.float64],
    g: NDArray[np.float64],
    M: NDArray[np.float64],
    A: NDArray[np.float64],
    b: NDArray[np.float64],
) -> None:
    """Turn the equations of the nine entries into those of the parameters: A (7, 7), lower triangle, and b (7,)."""
    tangent_of(frame, M)
    t = np.empty(9)
    for p in range(7):
        for i in range(9):
            value = 0.0
            for k in range(9):
                value += (H[i, k] if i >= k else H[k, i]) * M[k, p]
            t[i] = value
        for q in range(p, 7):
            value = 0.0
            for i in range(9):
                value += M[i, q] * t[i]
            A[q, p] = value
        value = 0.0
        for i in range(9):
            value += M[i, p] * g[i]
        b[p] = value


@kernel
def descend(
    matches: NDArray[np.float64],
    chosen: NDArray[np.int64],
    n_chosen: int,
    frame: NDArray[np.float64],
    width: float,
    steps: int,
    tolerance: float,
) -> float:
    """Move the frame down the biweight loss by at most so many steps of Levenberg and Marquardt; return the loss.

    It ends where a step that is taken gains no more than `tolerance` times the loss. Steps that lead up are refused.
    """
    H, g, M = np.empty((9, 9)), np.empty(9), np.empty((9, 7))
    newH, newg = np.empty((9, 9)), np.empty(9)
    A, b, damped, L = np.empty((7, 7)), np.empty(7), np.empty((7, 7)), np.empty((7, 7))
    step, moved, f = np.zeros(7), np.empty(19), np.empty(9)
    matrix_of(frame, f)
    loss = normal_equations(matches, chosen, n_chosen, f, width, H, g)
    damping = _DAMPING
    fresh = True
    for _ in range(steps):
        if fresh:
            reduced(frame, H, g, M, A, b)
        largest = 0.0
        for i in range(7):
            largest = max(largest, A[i, i])
        if not largest > 0.0:
            break
        for i in range(7):
            for k in range(i + 1):
                damped[i, k] = A[i, k]
            damped[i, i] += damping * A[i, i] + _FLOOR * largest
        fresh = False
        if _solve(damped, b, L, step):
            for i in range(7):
                step[i] = -step[i]
            stepped(frame, step, moved)
            matrix_of(moved, f)
            newloss = normal_equations(matches, chosen, n_chosen, f, width, newH, newg)
            if newloss < loss:
                gain = loss - newloss
                loss = newloss
                for i in range(19):
                    frame[i] = moved[i]
                H, newH = newH, H
                g, newg = newg, g
                damping /= _EASIER
                fresh = True
                if gain <= tolerance * loss:
                    break
                continue
        damping *= _HARDER
        if damping > 1e8:
            break
    return loss


@kernel
def within(
    matches: NDArray[np.float64],
    frame: NDArray[np.float64],
    limit: float,
    pool: NDArray[np.int64],
    f: NDArray[np.float64],
) -> int:
    """Write the matches within the limit of the frame's matrix into the pool's first places; return how many.

    The pool, a permutation of all matches, stays one.
    """
    matrix_of(frame, f)
    most = limit * limit
    count = 0
    for place in range(pool.shape[0]):
        i = pool[place]
        x, y, u, v = matches[0, i], matches[1, i], matches[2, i], matches[3, i]
        a0, a1, a2 = f[0] * x + f[1] * y + f[2], f[3] * x + f[4] * y + f[5], f[6] * x + f[7] * y + f[8]
        b0, b1 = f[0] * u + f[3] * v + f[6], f[1] * u + f[4] * v + f[7]
        error = u * a0 + v * a1 + a2
        if error * error <= most * (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1):
            pool[place] = pool[count]
            pool[count] = i
            count += 1
    return count


@kernel
def anneal(
    matches: NDArray[np.float64],
    frame: NDArray[np.float64],
    limit: float,
    widest: float,
    everything: NDArray[np.int64],
    best: NDArray[np.float64],
    record: NDArray[np.float64],
) -> bool:
    """Descend at widths from `widest` times the limit down to twice the limit; keep the best frame that is met.

    The frame that it begins with counts, too. `best`, shape (19,), is the best frame so far and `record`, shape (2,),
    its number of matches within the limit and its truncated loss, by which ties are broken; both are written. Returns
    whether the number has grown.
    """
    f = np.empty(9)
    grown = False
    width = max(widest, NARROWEST)
    last = False
    while True:
        matrix_of(frame, f)
        count, loss = score(matches, f, limit)
        if count > record[0] or (count == record[0] and loss < record[1]):
            grown = grown or count > record[0]
            record[0], record[1] = count, loss
            best[:] = frame
        if last:
            return grown
        last = width <= NARROWEST
        descend(
            matches,
            everything,
            everything.shape[0],
            frame,
            width * limit,
            _LAST_STEPS if last else _STEPS,
            _TOLERANCE,
        )
        width = max(_SHRINKING * width, NARROWEST)
