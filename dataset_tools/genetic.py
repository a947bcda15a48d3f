"""The genetic algorithm that picks keyframes (paper 3.1): population 100, crossover 0.8, mutation 0.1, tournaments.

A genome is a sorted row of distinct free nodes; the mandatory ones are no genes, as every selection has them. One
individual starts from a given selection, and the best one always survives, so the result is never worse than that.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from dataset_tools.fitness import Problem, fitness

TOLERANCE = 1e-12
"""A smaller gain [m] moves no gene."""


@dataclass(frozen=True)
class GeneticOptions:
    """Settings of the search; the paper gives the first three and the tournament.

    Args:
        population: genomes per generation.
        crossover: probability that a child has two parents.
        mutation: probability that a gene changes.
        tournament: genomes that compete to be a parent.
        generations: at most so many.
        patience: generations without improvement after which the search stops.
        local_step: half of the mutations move a gene by at most so many free nodes, the others anywhere.
        refine: whether each new best genome is improved by coordinate descent.
    """

    population: int = 100
    crossover: float = 0.8
    mutation: float = 0.1
    tournament: int = 3
    generations: int = 100
    patience: int = 15
    local_step: int = 3
    refine: bool = True

    def __post_init__(self) -> None:
        for name in ("population", "tournament", "generations", "patience", "local_step"):
            if getattr(self, name) < 1:
                raise ValueError(f"genetic.{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("crossover", "mutation"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"genetic.{name} is {getattr(self, name)}; a probability lies in 0..1")


def evolve(
    problem: Problem, seed: Int[np.ndarray, " k"], rng: np.random.Generator, options: GeneticOptions
) -> Int[np.ndarray, " k"]:
    """Selection with as many nodes as ``seed`` and an error that is at most the seed's.

    Args:
        problem: path, mandatory nodes and cost table.
        seed: sorted nodes of the individual that the first generation is given, mandatory ones included.
        rng: the only source of chance.
        options: rates and limits.
    """
    best = np.searchsorted(problem.free, np.setdiff1d(seed, problem.mandatory))
    genes, places = len(best), len(problem.free)
    if genes in (0, places):
        return seed
    genomes = distinct(rng.integers(places, size=(options.population, genes)), places)
    genomes[0], best_error, idle = best, np.inf, 0
    for _ in range(options.generations):
        errors = problem.errors(selections(problem, genomes))
        leader = int(errors.argmin())
        idle = 0 if errors[leader] < best_error else idle + 1
        if idle == 0:
            best = refine(problem, genomes[leader]) if options.refine else genomes[leader].copy()
            best_error = problem.error(selections(problem, best[None])[0])
            genomes[leader], errors[leader] = best, best_error
        if idle >= options.patience:
            break
        genomes = offspring(genomes, fitness(errors), places, rng, options)
        genomes[0] = best
    return selections(problem, best[None])[0]


def selections(problem: Problem, genomes: Int[np.ndarray, "p g"]) -> Int[np.ndarray, "p k"]:
    """Sorted nodes that each genome (indices into ``problem.free``) stands for."""
    kept = np.broadcast_to(problem.mandatory, (len(genomes), len(problem.mandatory)))
    return np.sort(np.concatenate([problem.free[genomes], kept], axis=1), axis=1)


def distinct(genomes: Int[np.ndarray, "p g"], places: int) -> Int[np.ndarray, "p g"]:
    """Nearest rows that are sorted, without repetition, and inside 0..places - 1."""
    rank = np.arange(genomes.shape[1])
    slack = np.maximum.accumulate(np.sort(genomes, axis=1) - rank, axis=1)
    return np.clip(slack, 0, places - genomes.shape[1]) + rank


def offspring(
    genomes: Int[np.ndarray, "p g"],
    strength: Float[np.ndarray, " p"],
    places: int,
    rng: np.random.Generator,
    options: GeneticOptions,
) -> Int[np.ndarray, "p g"]:
    """Next generation: tournaments, one-point crossover on sorted genes, mutation half of which is local."""
    population, genes = genomes.shape
    rivals = rng.integers(population, size=(2, population, options.tournament))
    winners = np.take_along_axis(rivals, strength[rivals].argmax(-1)[..., None], axis=-1)[..., 0]
    first, second = genomes[winners]
    cut = np.where(rng.random(population) < options.crossover, rng.integers(genes + 1, size=population), genes)
    children = np.where(np.arange(genes) < cut[:, None], first, second)
    mutated = rng.random(children.shape) < options.mutation
    nearby = children + rng.integers(-options.local_step, options.local_step + 1, size=children.shape)
    anywhere = rng.integers(places, size=children.shape)
    moved = np.where(rng.random(children.shape) < 0.5, nearby, anywhere)
    return distinct(np.where(mutated, moved, children), places)


def refine(problem: Problem, genome: Int[np.ndarray, " g"]) -> Int[np.ndarray, " g"]:
    """Coordinate descent: each gene, then each two neighbours, go to their best places while the others stay."""
    moved = True
    while moved:
        genome, moved = moved_singly(problem, genome)
        if not moved:
            genome, moved = moved_in_pairs(problem, genome)
    return genome


def moved_singly(problem: Problem, genome: Int[np.ndarray, " g"]) -> tuple[Int[np.ndarray, " g"], bool]:
    """Each gene in turn at its best place anywhere; and whether one moved."""
    moved = False
    for gene in range(len(genome)):
        others = np.delete(genome, gene)
        gains = insertion_gains(problem, selections(problem, others[None])[0])
        place = int(gains.argmax())
        if gains[place] > gains[genome[gene]] + TOLERANCE:
            genome, moved = np.sort(np.append(others, place)), True
    return genome, moved


def moved_in_pairs(problem: Problem, genome: Int[np.ndarray, " g"]) -> tuple[Int[np.ndarray, " g"], bool]:
    """Each two genes with no mandatory node between them at their best places between their neighbours."""
    selection, moved = selections(problem, genome[None])[0], False
    is_free = np.isin(selection, problem.free)
    for place in np.flatnonzero(is_free[1:-2] & is_free[2:-1]) + 1:
        left, first, second, right = selection[place - 1 : place + 3].tolist()
        cost = problem.cost[left : right + 1, left : right + 1]
        errors = cost[0, 1:-1, None] + cost[1:-1, 1:-1] + cost[1:-1, -1]
        best = np.unravel_index(errors.argmin(), errors.shape)
        if errors[best] < errors[first - left - 1, second - left - 1] - TOLERANCE:
            selection[place : place + 2] = left + 1 + np.array(best)
            moved = True
    return np.searchsorted(problem.free, selection[is_free]), moved


def insertion_gains(problem: Problem, selection: Int[np.ndarray, " k"]) -> Float[np.ndarray, " f"]:
    """How much the error [m] falls when a free node joins ``selection``; ``-inf`` for nodes already in it."""
    after = np.searchsorted(selection, problem.free)
    left, right = selection[after - 1], selection[after]
    gains = problem.cost[left, right] - problem.cost[left, problem.free] - problem.cost[problem.free, right]
    return np.where(right == problem.free, -np.inf, gains)
