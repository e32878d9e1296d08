from sb3_symphony.redq.droq import DroQ
from sb3_symphony.redq.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_symphony.redq.redq import REDQ

__all__ = ["REDQ", "CnnPolicy", "DroQ", "MlpPolicy", "MultiInputPolicy"]
