"""Makes the learner for a configuration."""

from training.data.responses import ResponseSet
from training.learning.factorised import FactorisedLearner
from training.learning.naf import NafLearner
from training.learning.runs import Configuration


def learner_of(responses: ResponseSet, configuration: Configuration) -> FactorisedLearner | NafLearner:
    """A learner with new parameters, drawn from torch's generator."""
    return (NafLearner if configuration.kind == "naf" else FactorisedLearner)(responses, configuration)
