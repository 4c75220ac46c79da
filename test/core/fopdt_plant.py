"""A first-order process with dead time by its closed form: a truth of the tests' own.

Between changes of the delayed input, y(t) = K u + (y(t0) - K u) exp(-(t - t0)/tau). It shares
nothing with the package.
"""

import math


class FopdtPlant:
    """K exp(-D s)/(tau s + 1), at rest at command 0; tau < 0 with K < 0 is the unstable one."""

    def __init__(self, gain, time_constant, dead_time):
        self.gain, self.tau, self.dead_time = gain, time_constant, dead_time
        self.time = self.y = self.u = self.last = 0.0
        self.queue = []

    def advance(self, time, command):
        """Hold the command from now on and return the output at `time`."""
        if command != self.last:
            self.queue.append((self.time + self.dead_time, command))
            self.last = command
        now = self.time
        while self.queue and self.queue[0][0] <= time:
            change, level = self.queue.pop(0)
            self.y = self._after(change - now)
            now, self.u = change, level
        self.y = self._after(time - now)
        self.time = time
        return self.y

    def _after(self, span):
        target = self.gain * self.u
        return target + (self.y - target) * math.exp(-span / self.tau)


def run(experiment, plant, period, *, noise=None, offset=0.0, samples=200_000):
    """Feed an experiment from a plant until it ends; return the number of samples taken."""
    command = experiment.safe_command
    for k in range(samples):
        y = offset + plant.advance(k * period, command - experiment.safe_command)
        if noise is not None:
            y += noise()
        command = experiment.step(k * period, y)
        if experiment.finished:
            return k + 1
    return samples
