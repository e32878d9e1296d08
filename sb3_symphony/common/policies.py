"""What the policies of Symphony and REDQ share."""

from collections.abc import Sequence
from typing import Any, ClassVar

from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor

from sb3_symphony.common.averaging import AveragedActor
from sb3_symphony.common.checks import check_choice, check_number
from sb3_symphony.common.ensembles import EnsembleCritic
from sb3_symphony.common.regression import ENGINES

LayerNorms = bool | Sequence[bool]


class EnsemblePolicy(AveragedActor):
    """Mixin, in front of SB3's ``SACPolicy`` or ``TD3Policy``: an ensemble of critics, and an average of the actor."""

    critic: EnsembleCritic
    critic_target: EnsembleCritic
    default_features_extractor: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor

    def keep_options(
        self,
        layer_norm: LayerNorms | dict[str, LayerNorms],
        dropout_rate: float,
        value_range: tuple[float, float] | None,
        n_bins: int,
        critic_engine: str,
        actor_averaging: float,
    ) -> None:
        """Check and keep what both have; to be called before the parent, which builds the networks."""
        check_choice("critic_engine", critic_engine, ENGINES)
        check_number("actor_averaging", actor_averaging, 0, 1)
        self.layer_norm, self.dropout_rate = layer_norm, dropout_rate
        self.value_range, self.n_bins = value_range, n_bins
        self.critic_engine, self.actor_averaging = critic_engine, actor_averaging

    def set_training_mode(self, mode: bool) -> None:
        super().set_training_mode(mode)
        # SB3 keeps targets in evaluation mode; dropout is active in them too, as in DroQ
        self.critic_target.q_networks.train(mode and self.dropout_rate > 0)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(layer_norm=self.layer_norm, dropout_rate=self.dropout_rate)
        data.update(value_range=self.value_range, n_bins=self.n_bins)
        data.update(critic_engine=self.critic_engine, actor_averaging=self.actor_averaging)
        return data
