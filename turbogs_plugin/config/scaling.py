"""Scaling of settings: those that count iterations, to a run of another length; those that make the batch of an
iteration, and the learning rates, to more processes."""

from __future__ import annotations

from turbogs_plugin.config.configuration import Config, resolve

ITERATION_FIELDS = {
    "train": ("refine_until", "sh_interval"),
    "density": ("refine_from", "refine_every", "final_every", "refine_start_iter"),
}
"""Settings that count iterations: a run of another length scales them. gsplat's interval of resets is not among them:
what a reset of opacities takes away grows back at the rate of the optimizer, however short the run."""

SHORTEST_INTERVAL = 10
"""Shortest interval of density control that scaling makes: its statistics need a window of some iterations."""
REGROWTH = 50
"""Iterations in which opacities grow back what an event of density control takes; an event that comes sooner takes
less."""
BATCH_FIELDS = ("min_views", "max_views", "views", "pixel_budget")
"""Settings of a schedule that grow with the batch."""
RATE_EXPONENT = 0.5
"""Learning rates grow with this power of the batch. Where a gradient is mostly noise, Adam's step has the length of its
rate whatever the batch, and n small steps go as far as one that is sqrt(n) times as long (Malladi et al. 2022; for
Gaussians: Grendel, Zhao et al. 2024)."""
MOMENT_FIELDS = ("beta1", "beta2")
"""Decays of an optimizer's moments, raised to the power of the batch: moments then forget after a number of samples,
not of iterations (Grendel)."""


def with_iterations(config: Config, iterations: int) -> Config:
    """The configuration for a run of exactly this length, with everything scaled that counts iterations. Intervals of
    density control stay at `SHORTEST_INTERVAL` or above; 0 stays 0."""
    mapping, factor = config.to_mapping(), iterations / config.train.written_iterations
    density = mapping["density"]
    interval = density.get("refine_every", REGROWTH)
    for section, names in ITERATION_FIELDS.items():
        for name in names:
            value = mapping[section].get(name, 0)
            if value:
                least = min(value, SHORTEST_INTERVAL) if section == "density" else 1
                mapping[section][name] = max(least, round(value * factor))
    mapping["train"]["iterations"] = iterations
    before, after = min(REGROWTH, interval), min(REGROWTH, density.get("refine_every", REGROWTH))
    if density.get("opacity_decay", 0.0) and before != after:
        density["opacity_decay"] = 1.0 - (1.0 - density["opacity_decay"]) ** (after / before)
    return resolve(mapping)


def with_batch_for(config: Config, processes: int) -> Config:
    """The configuration for `processes` that train together, from one whose batch is written for one process: views and
    pixels of an iteration grow by their number, learning rates by its root."""
    mapping = config.to_mapping()
    schedule, optimizer = mapping["schedule"], mapping["optimizer"]
    for name in set(BATCH_FIELDS) & set(schedule):
        schedule[name] *= processes
    for name in set(MOMENT_FIELDS) & set(optimizer):
        optimizer[name] **= processes
    for section in (optimizer, mapping["density"]):  # 3DGS-MCMC's noise goes by learning rates, too
        rates = section.get("learning_rates")
        if isinstance(rates, dict) and "batch_scale" in rates:
            rates["batch_scale"] *= processes**RATE_EXPONENT
            rates["written_for"] = rates.get("written_for", 0) // processes  # a larger batch takes fewer iterations
    mapping["train"]["batch_for"] = processes
    return resolve(mapping)
