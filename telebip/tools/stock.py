"""rsl-rl's own PPO in telebip's training loop, to be compared with."""

from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage

from telebip.rl.train import Trainer


class StockTrainer(Trainer):
    """Trains with rsl-rl's PPO and storage as they stand, and the same networks: in the same arithmetic, it acts the same."""

    algorithm = PPO
    storage = RolloutStorage
