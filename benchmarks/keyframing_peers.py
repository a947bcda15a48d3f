"""Other people's ways to choose k of n nodes on the same cost table, for ``keyframing_methods.py``.

The three libraries of genetic algorithms get the paper's settings: population 100, 100 generations, one-point crossover
0.8, mutation 0.1, tournaments of 3, one elite. Genomes are repaired as ours are, so that every one is a selection.
"""

import random
import warnings

import deap.base
import deap.creator
import deap.tools
import numpy as np
import pygad
import rdp as rdp_package
from jaxtyping import Float, Int
from pymoo.algorithms.soo.nonconvex.ga import GA
from pymoo.core.problem import Problem as PymooProblem
from pymoo.operators.crossover.pntx import SinglePointCrossover
from pymoo.operators.mutation.pm import PM
from pymoo.operators.repair.rounding import RoundingRepair
from pymoo.operators.sampling.rnd import IntegerRandomSampling
from pymoo.optimize import minimize

from dataset_tools.fitness import Problem, deviations
from dataset_tools.genetic import distinct, selections

POPULATION, GENERATIONS, CROSSOVER, MUTATION, TOURNAMENT = 100, 100, 0.8, 0.1, 3
Selection = Int[np.ndarray, " k"]

warnings.filterwarnings("ignore", module="pygad")


def repaired(problem: Problem, genomes: Int[np.ndarray, "p g"]) -> Int[np.ndarray, "p k"]:
    """Selections that genomes stand for."""
    return selections(problem, distinct(np.asarray(genomes, dtype=np.int64), len(problem.free)))


def with_pygad(problem: Problem, k: int, seed: int) -> Selection:
    """PyGAD, fitness by the batch."""

    def strength(_: object, genomes: Float[np.ndarray, "p g"], __: object) -> list[float]:
        return list(-problem.errors(repaired(problem, np.atleast_2d(genomes))))

    search = pygad.GA(
        num_generations=GENERATIONS,
        num_parents_mating=POPULATION,
        fitness_func=strength,
        fitness_batch_size=POPULATION,
        sol_per_pop=POPULATION,
        num_genes=k - len(problem.mandatory),
        gene_type=int,
        gene_space=range(len(problem.free)),
        parent_selection_type="tournament",
        K_tournament=TOURNAMENT,
        crossover_type="single_point",
        crossover_probability=CROSSOVER,
        mutation_type="random",
        mutation_probability=MUTATION,
        keep_elitism=1,
        random_seed=seed,
        suppress_warnings=True,
    )
    search.run()
    genome, *_ = search.best_solution()
    return repaired(problem, genome[None])[0]


def with_deap(problem: Problem, k: int, seed: int) -> Selection:
    """DEAP's toolbox: its individuals, tournaments, crossover, mutation and hall of fame."""
    random.seed(seed)
    genes, places = k - len(problem.mandatory), len(problem.free)
    if not hasattr(deap.creator, "Genome"):
        deap.creator.create("Least", deap.base.Fitness, weights=(-1.0,))
        deap.creator.create("Genome", list, fitness=deap.creator.Least)
    population = [deap.creator.Genome(random.choices(range(places), k=genes)) for _ in range(POPULATION)]
    best = deap.tools.HallOfFame(1)
    for _ in range(GENERATIONS):
        for genome, error in zip(population, problem.errors(repaired(problem, np.array(population))), strict=True):
            genome.fitness.values = (error,)
        best.update(population)
        chosen = deap.tools.selTournament(population, POPULATION - 1, TOURNAMENT)
        children = [deap.creator.Genome(sorted(genome)) for genome in chosen]
        for first, second in zip(children[::2], children[1::2], strict=False):
            if genes > 1 and random.random() < CROSSOVER:
                deap.tools.cxOnePoint(first, second)
        for child in children:
            deap.tools.mutUniformInt(child, 0, places - 1, MUTATION)
        population = [deap.creator.Genome(best[0]), *children]
    return repaired(problem, np.array(best[0])[None])[0]


class Selecting(PymooProblem):
    """The problem as pymoo sees it."""

    def __init__(self, problem: Problem, genes: int) -> None:
        super().__init__(n_var=genes, n_obj=1, xl=0, xu=len(problem.free) - 1, vtype=int)
        self._problem = problem

    def _evaluate(self, genomes: Int[np.ndarray, "p g"], out: dict[str, object], *_: object, **__: object) -> None:
        out["F"] = self._problem.errors(repaired(self._problem, genomes))


def with_pymoo(problem: Problem, k: int, seed: int) -> Selection:
    """The genetic algorithm of pymoo, on integers."""
    genes = k - len(problem.mandatory)
    search = GA(
        pop_size=POPULATION,
        sampling=IntegerRandomSampling(),
        crossover=SinglePointCrossover(prob=CROSSOVER, repair=RoundingRepair()),
        mutation=PM(prob=1.0, prob_var=MUTATION, eta=3.0, vtype=float, repair=RoundingRepair()),
        eliminate_duplicates=False,
    )
    found = minimize(Selecting(problem, genes), search, ("n_gen", GENERATIONS), seed=seed, verbose=False)
    return repaired(problem, np.atleast_2d(found.X))[0]


def with_rdp_package(problem: Problem, k: int, _: int) -> Selection:
    """The package ``rdp``; its epsilon is bisected until k nodes remain."""
    best: Selection = np.arange(2)
    low, high = 0.0, 1.0
    for _ in range(20):
        middle = (low + high) / 2
        kept = np.flatnonzero(rdp_package.rdp(problem.points, epsilon=middle, algo="iter", return_mask=True))
        if len(kept) <= k:
            best, high = kept, middle
        else:
            low = middle
    return filled(problem, best, k)


def with_awe(problem: Problem, k: int, _: int) -> Selection:
    """AWE's dynamic program (Shi et al. 2023) re-stated: fewest waypoints under a largest deviation, bisected to k."""
    points, n = problem.points, len(problem.points)
    worst = np.zeros((n, n))
    for start in range(n):
        for stop in range(start + 2, n):
            worst[start, stop] = deviations(points, start, stop).max()
    low, high, best = 0.0, float(worst[0, -1]), np.array([0, n - 1])
    for _ in range(20):
        middle = (low + high) / 2
        found = fewest_waypoints(worst, middle)
        if len(found) <= k:
            best, high = found, middle
        else:
            low = middle
    return filled(problem, best, k)


def fewest_waypoints(worst: Float[np.ndarray, "n n"], limit: float) -> Selection:
    """Fewest nodes between which no deviation is above ``limit`` [m]."""
    count, before = [1], [0]
    for node in range(1, len(worst)):
        options = [(count[earlier] + 1, earlier) for earlier in range(node) if worst[earlier, node] <= limit]
        least, earlier = min(options)
        count.append(least)
        before.append(earlier)
    nodes = [len(worst) - 1]
    while nodes[-1] > 0:
        nodes.append(before[nodes[-1]])
    return np.array(nodes[::-1])


def filled(problem: Problem, selection: Selection, k: int) -> Selection:
    """The selection with the nodes added that lower the summed error most, until there are k: methods with their own
    number of nodes may stop short of it.
    """
    while len(selection) < k:
        candidates = np.array([np.sort(np.append(selection, node)) for node in np.setdiff1d(problem.free, selection)])
        selection = candidates[problem.errors(candidates).argmin()]
    return selection


PEERS = {
    "PyGAD": with_pygad,
    "DEAP": with_deap,
    "pymoo": with_pymoo,
    "rdp (package)": with_rdp_package,
    "AWE (re-stated)": with_awe,
}
