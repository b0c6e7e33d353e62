"""Makes the learner for a configuration."""

from training.data.responses import ResponseSet
from training.learning.directional import DirectionalLearner
from training.learning.factorised import FactorisedLearner
from training.learning.naf import NafLearner
from training.learning.runs import Configuration

_LEARNERS: dict[str, type[FactorisedLearner | DirectionalLearner | NafLearner]] = {
    "factorised": FactorisedLearner,
    "directional": DirectionalLearner,
    "naf": NafLearner,
}


def learner_of(
    responses: ResponseSet, configuration: Configuration
) -> FactorisedLearner | DirectionalLearner | NafLearner:
    """A learner with new parameters, drawn from torch's generator. Raises RecipeError if the configuration does not fit
    the data."""
    return _LEARNERS[configuration.kind](responses, configuration)
