"""How far off a model file is expected to be that is fitted to a recording, as a function of rows.

The unknowns xi of an arm are what is not as its model says, each in units in which its prior has
variance one. Of a recording whose rows over their noise have the products H, a file is fitted with
those unknowns f that it holds and their priors; the others n, such as friction at standstill, are
in its torque all the same. With A = (H_ff + 1)^-1 and B = A H_fn, the unknowns less the file's are

    A xi_f - B xi_n - A noise,    xi_n,

and their covariance is S_ff = A + B B', S_fn = -B, S_nn = 1, as A A + A H_ff A = A. On motions
whose rows have the products G, the squares of the file's error are expected to be

    E = tr(G S) = tr(G_ff A) + tr(B' G_ff B) - 2 tr(G_nf B) + tr(G_nn),
    dE = -tr(W dH),  W_ff = A G_ff A + A K B' + B K' A,  W_fn = -A K,  W_nn = 0,  K = G_ff B - G_fn.

That is of a file whose terms are all fitted at once, which a search can derive. What is stated of a
motion is nearer to how a file is made: its bodies and rotors are those of the fit of all terms,
whose priors keep them from taking up other torque, and its friction is fitted beside them. Friction
and rotors are held at zero where they would be negative, so that they are off by no more than they
are large. Of a designed motion both numbers are within a tenth of each other; of slow ones the
first is up to six times as large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array


@dataclass(frozen=True)
class FileFit:
    """How a file is fitted to P unknowns.

    Attributes:
        in_file: (P,) which unknowns the file holds.
        refitted: (P,) which of these are fitted beside the others, once those are known.
        bounded: (P,) which of these are of numbers that cannot be negative.
    """

    in_file: NDArray[np.bool_]
    refitted: NDArray[np.bool_]
    bounded: NDArray[np.bool_]

    def covariance(self, information: Array) -> Array:
        """Return the covariance (P, P) of all unknowns less those of the file, as it is fitted.

        ``information`` is H + 1 (P, P), that of a recording and of the priors.
        """
        identity = np.eye(len(information))
        recorded = information - identity
        # Errors are linear in the unknowns, and in the products of rows and noise, whose covariance
        # is H. What the file does not hold is left as it is.
        by_truth = identity.copy()
        by_noise = np.zeros_like(identity)
        first = self.in_file & ~self.refitted
        posterior = np.linalg.inv(information)[first]
        by_truth[first] = posterior
        by_noise[first] = -posterior

        last = np.flatnonzero(self.refitted)
        others = np.flatnonzero(~self.refitted)
        inverse = np.linalg.inv(information[np.ix_(last, last)])
        taken_up = inverse @ recorded[np.ix_(last, others)]
        by_truth[last] = inverse @ identity[last] - taken_up @ by_truth[others]
        by_noise[last] = -inverse @ identity[last] - taken_up @ by_noise[others]

        covariance = by_truth @ by_truth.T + by_noise @ recorded @ by_noise.T
        deviations = np.sqrt(np.diag(covariance))
        excess = np.where(self.bounded, np.maximum(deviations, 1.0), 1.0)
        return np.asarray(covariance / np.outer(excess, excess))


@dataclass(frozen=True)
class FileErrors(FileFit):
    """The squared errors of a file on some motions.

    Attributes:
        elsewhere: (P, P) products G of the rows of these motions, per unit of each unknown.
    """

    elsewhere: Array

    @classmethod
    def at_once(cls, elsewhere: Array, in_file: NDArray[np.bool_]) -> FileErrors:
        """Return the errors of a file whose terms are all fitted at once, without bounds."""
        return cls(in_file, in_file, np.zeros_like(in_file), elsewhere)

    @property
    def before(self) -> float:
        """Expected squares of the model's error, whose unknowns are as large as their priors."""
        return float(np.trace(self.elsewhere))

    def value_and_weight(self, information: Array) -> tuple[float, Array]:
        """Return ln(E / E_0) / 2 and W / E (P, P) of a file whose terms are fitted at once.

        E_0 are the squares of the model's error. A value that is 0.01 lower is an error that is 1 %
        smaller. It is infinite, and the weight zero, where the information H + 1 (P, P) is not
        finite.
        """
        weight = np.zeros_like(information)
        if not np.all(np.isfinite(information)):
            return np.inf, weight
        held = np.flatnonzero(self.in_file)
        left_out = np.flatnonzero(~self.in_file)
        inverse, taken_up = self._fit(information)
        of_held = self.elsewhere[np.ix_(held, held)]
        mixed = self.elsewhere[np.ix_(held, left_out)]
        of_left_out = self.elsewhere[left_out, left_out]

        pulled = of_held @ taken_up
        squares = np.vdot(of_held, inverse) + np.sum(of_left_out)
        squares += np.vdot(pulled - 2.0 * mixed, taken_up)

        by_mixed = -inverse @ (pulled - mixed)
        spread = by_mixed @ taken_up.T
        by_held = inverse @ of_held @ inverse - spread - spread.T
        weight[np.ix_(held, held)] = by_held
        weight[np.ix_(held, left_out)] = by_mixed
        weight[np.ix_(left_out, held)] = by_mixed.T
        value = 0.5 * float(np.log(squares / self.before))
        return value, weight / squares

    def _fit(self, information: Array) -> tuple[Array, Array]:
        """Return A, and B: what the file takes up of the unknowns that it does not hold."""
        rows = information[self.in_file]
        inverse = np.asarray(np.linalg.inv(rows[:, self.in_file]))
        return inverse, inverse @ rows[:, ~self.in_file]
