from sb3_symphony.symphony.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_symphony.symphony.symphony import Symphony

__all__ = ["CnnPolicy", "MlpPolicy", "MultiInputPolicy", "Symphony"]
