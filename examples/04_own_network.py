"""A network of your own: three plain convolutions in place of the dense net.

python examples/04_own_network.py [PRESET] [RUN_DIR]
"""

import sys

import flax.linen as nn

import csac_jax as csac


class PlainNet(nn.Module):
    """Rotated maps [N, C, C, I] -> Q [N, C / 2, C / 2, 3] and features [N, C / 2, C / 2, F].

    Q has a map for a push ahead, a push back and a grasp in the frame of the maps.
    """

    width: int = 24
    stride: int = 2  # cells of the input per cell of Q

    @nn.compact
    def __call__(self, maps, train=False):
        features = nn.relu(nn.Conv(self.width, (4, 4), strides=self.stride)(maps))
        for dilation in (1, 2):
            features = nn.Conv(self.width, (3, 3), kernel_dilation=dilation)(features)
            features = nn.relu(nn.GroupNorm(num_groups=4)(features))
        return nn.Dense(3, kernel_init=nn.initializers.zeros)(features), features


def main(preset="quick", run_dir=None):
    return csac.train(csac.presets.get(preset), run_dir, network=PlainNet())


if __name__ == "__main__":
    print(main(*sys.argv[1:]).summary)
