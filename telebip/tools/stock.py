"""rsl-rl's own PPO in telebip's training loop, to be compared with."""

from rsl_rl.algorithms import PPO

from telebip.rl.train import Trainer


class StockTrainer(Trainer):
    """Trains with rsl-rl's PPO as it stands, on the same networks: in the same arithmetic it takes the same actions."""

    algorithm = PPO
