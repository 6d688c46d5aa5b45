"""Algorithm 1 of "Cooperative Deep Q-learning ..." (arXiv 2110.15305) on CartPole, with everything in one file.

    python examples/coop_single_file.py --method coop --seed 0 --steps 5000 > episodes.csv

Four methods: dqn and edql train one network towards a copy of itself; g-coop and coop train two independent networks,
which take turns: one acts and is trained, the other gives the targets. dqn and g-coop follow the gradient; edql and
coop follow error-driven learning (EDL). Needs numpy, PyTorch and gymnasium.

The settings are those of `coop-lockstep --preset cartpole-paper --learner.optimizer rmsprop`, and so are the random
numbers and the order of the arithmetic: the output equals that run's episodes.csv to the byte.

Notation, for one state x: inputs h(0) = x; pre-activations a(i) = W(i) h(i-1) + b(i); h(i) = relu(a(i)); Q(x) = a(4).
Arrays of a batch are [batch, units].
"""

import argparse
import itertools
import math
import sys

import gymnasium
import numpy as np
import torch
from torch import nn

METHODS = {"dqn": (False, False), "edql": (False, True), "g-coop": (True, False), "coop": (True, True)}  # (two, EDL)
INPUTS, HIDDEN, ACTIONS = 4, 128, 2
BATCH, CAPACITY, LEARNING_STARTS = 32, 5000, 128
SWAP_EVERY = 30  # C: updates between swaps of the roles, or copies to the target network
GAMMA = np.float32(0.99)
ALPHA, EPS = 0.99, 1e-8  # RMSProp's
FIRST_RATE, RATE_DECAY = 3e-4, 0.0266  # the learning rate, and its factor over 50,000 steps
FIRST_S, S_DECAY = 0.1, 0.9  # scale of s, and its factor every 1,000 updates
EPISODE_STEPS = 200  # CartPole-v0
TINY = np.float32(1e-37)


class Network:
    """Three hidden layers of 128 ReLUs.

    weights: float32 [out, in] each. biases: float32 [out, 1] each.
    """

    def __init__(self, seed):
        torch.manual_seed(seed)  # for PyTorch's default initialisation
        sizes = [INPUTS, HIDDEN, HIDDEN, HIDDEN, ACTIONS]
        layers = [nn.Linear(inputs, outputs) for inputs, outputs in itertools.pairwise(sizes)]
        self.weights = [layer.weight.detach().numpy() for layer in layers]
        self.biases = [layer.bias.detach().numpy()[:, None] for layer in layers]
        self.squares = [np.zeros_like(theta) for theta in self.parameters()]  # RMSProp's running mean of g^2

    def parameters(self):
        """All parameters, to be changed in place."""
        return [*self.weights, *self.biases]

    def forward(self, x):
        """float32 [batch, 4] -> [h(0), h(1), h(2), h(3), Q(x)]."""
        columns = [x.T]  # [units, batch], as in a(i) = W(i) h(i-1) + b(i)
        for weight, bias in zip(self.weights, self.biases, strict=True):
            a = weight @ columns[-1] + bias
            columns.append(a if weight is self.weights[-1] else np.maximum(a, 0))
        return [x, *(np.ascontiguousarray(column.T) for column in columns[1:])]

    def q_values(self, x):
        """Q(x): float32 [batch, 2]."""
        column = x.T
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            column = np.maximum(weight @ column + bias, 0)
        return (self.weights[-1] @ column + self.biases[-1]).T

    def gradients(self, activations, signals):
        """The gradients of `parameters`, given the signal at each pre-activation, last layer first."""
        pairs = list(zip(reversed(signals), activations, strict=False))
        return [signal.T @ h for signal, h in pairs] + [np.add.reduce(signal, 0)[:, None] for signal, _ in pairs]

    def step(self, gradients, rate):
        """One step of RMSProp: v <- alpha v + (1 - alpha) g^2; theta <- theta - rate g / (sqrt(v) + eps)."""
        for theta, gradient, square in zip(self.parameters(), gradients, self.squares, strict=True):
            square[...] = square * ALPHA + gradient * gradient * (1 - ALPHA)
            theta[...] -= gradient / (np.sqrt(square + TINY) + EPS) * rate


def backpropagate(network, activations, rows):
    """Yield what arrives at a(4), a(3), a(2), a(1) of rows [batch or 1, k, 2] at the output: [batch, k, units]."""
    yield rows
    for weight, h in zip(network.weights[:0:-1], activations[-2:0:-1], strict=True):
        rows = np.matmul(rows.swapaxes(0, 1), weight).swapaxes(0, 1) * (h > 0)[:, None]
        yield rows


def edl(network, activations, error, s):
    """The signals sigma(i) = B(i)^T e at each a(i), last first. error: e, float32 [batch, 2].

    With T(i) = dQ / da(i) = U S V^T [2, units], the paper feeds back through B(i) = U (S + s I) V^T. Here
    U V^T = G^(-1/2) T with G = T T^T, so sigma(i) = T^T (e + s G^(-1/2) e): no SVD is needed. T of the last layer is
    the identity. The rows of T start from sum and difference of the actions, (Q1 + Q2) and (Q1 - Q2), over sqrt(2):
    an orthogonal change of basis, which keeps G well conditioned.
    """
    basis = (np.array([[1, 1], [1, -1]]) * 0.5**0.5).astype(np.float32)
    _, *transforms = backpropagate(network, activations, basis[None])
    signals, e = [error * (1 + s)], error @ basis.T
    grams = np.concatenate([np.vecdot(t[:, :, None], t[:, None]) for t in transforms]).reshape(-1, len(error), 2, 2)
    for t, g in zip(transforms, grams, strict=True):
        white, singular = inverse_root(g, e)
        sigma = np.matmul((e + s * white)[:, None], t)[:, 0]
        if singular.any():  # dead units: null directions have the singular value s along an orthonormal completion
            u, _, vh = torch.linalg.svd(torch.from_numpy(t[singular]).double(), full_matrices=False)
            sigma[singular] += s * (e[singular][:, None] @ (u @ vh).float().numpy())[:, 0]
        signals.append(sigma)
    return signals


def inverse_root(g, e):
    """G^(-1/2) e of symmetric G float32 [batch, 2, 2], e [batch, 2]; and where G is singular, to rounding: bool.

    G^(-1/2) = ((t + d) I - G) / (d sqrt(t + 2 d)), where d^2 = det G and t = trace G.
    """
    with np.errstate(all="ignore"):
        a, b, c = g[:, 0, 0], g[:, 1, 1], g[:, 0, 1]
        product, trace = a * b, a + b
        determinant = product - c * c
        singular = ~(determinant - (2 / 3e2) * product - 1e-31 * trace > 0)
        d = determinant**0.5
        scale = d * (trace + 2 * d) ** 0.5
        white = np.stack([((b + d) * e[:, 0] - c * e[:, 1]) / scale, ((a + d) * e[:, 1] - c * e[:, 0]) / scale], 1)
    white[singular] = 0
    return white, singular


def train(method, seed, steps, out=sys.stdout):
    """Run Algorithm 1; write a line to `out` for each episode."""
    two, error_driven = METHODS[method]
    env = gymnasium.make("CartPole-v1", max_episode_steps=-1)  # v0's physics; its limit of 200 steps is applied below
    env_seed, policy_seed = np.random.SeedSequence([seed, 3, 0]).spawn(2)
    policy, draws, noise = (np.random.default_rng(one) for one in (policy_seed, [seed, 1], [seed, 2]))
    (env_seed,) = np.random.SeedSequence(int(env_seed.generate_state(1)[0])).generate_state(1) & 0x7FFFFFFF
    seeds = [int(np.random.SeedSequence([seed, number if two else 0]).generate_state(1)[0]) for number in (0, 1)]
    networks = [Network(each) for each in seeds]
    acting = 0  # the flag: which network acts and is trained
    updates, planned = 0, steps - LEARNING_STARTS
    obs, actions, rewards, next_obs, live = (
        np.zeros((CAPACITY, INPUTS), np.float32), np.zeros(CAPACITY, np.int32), np.zeros(CAPACITY, np.float32),
        np.zeros((CAPACITY, INPUTS), np.float32), np.zeros(CAPACITY, bool),
    )  # fmt: skip
    print("episode,env_step,update,actor,stream,return,length,epsilon,s,q1_mean,q2_mean,param_version", file=out)
    x, episode, length = env.reset(seed=int(env_seed))[0], 0, 0
    for step in range(1, steps + 1):
        # Act: epsilon-greedy over the network that is trained.
        epsilon = 0.05 + (0.9 - 0.05) * math.exp(-(step - 1) / 200)
        if policy.random(1)[0] < epsilon:
            action = int(policy.integers(ACTIONS, size=1, dtype=np.int32)[0])
        else:
            action = int(networks[acting].q_values(x[None]).argmax(1)[0])
        version = updates
        # Store the transition in the place of the oldest one. A step that hits the time limit is not terminal.
        next_x, reward, terminated, _, _ = env.step(action)
        row, length = (step - 1) % CAPACITY, length + 1
        obs[row], actions[row], rewards[row], next_obs[row], live[row] = x, action, reward, next_x, not terminated
        over = terminated or length == EPISODE_STEPS
        means = [float(network.q_values(next_x[None]).mean()) for network in networks] if over else []
        x = next_x
        scale = FIRST_S * S_DECAY ** (updates / 1000) if error_driven else 0.0
        if step > LEARNING_STARTS:
            # Sample, and find the TD errors: the trained network chooses the next action, the other one values it.
            drawn = draws.integers(0, min(step, CAPACITY), BATCH)
            online, target = networks[acting], networks[1 - acting]
            activations = online.forward(np.concatenate((obs[drawn], next_obs[drawn])))
            q, next_q = activations[-1][:BATCH], activations[-1][BATCH:]
            value = target.q_values(next_obs[drawn])[np.arange(BATCH), next_q.argmax(1)]
            td_error = q[np.arange(BATCH), actions[drawn]] - (rewards[drawn] + GAMMA * live[drawn] * value)
            # The cost is the mean of e^2 / 2: only the entry of the action taken is not 0.
            error = np.zeros((ACTIONS, BATCH), np.float32).T
            error[np.arange(BATCH), actions[drawn]] = td_error / np.float32(BATCH)
            activations = [h[:BATCH] for h in activations]
            s = scale * float(noise.standard_normal()) if scale else 0.0
            if s:
                signals = edl(online, activations, error, s)
            else:
                signals = [rows[:, 0] for rows in backpropagate(online, activations, error[:, None])]
            rate = FIRST_RATE * (RATE_DECAY ** (steps / 50_000)) ** min(1.0, updates / planned)
            online.step(online.gradients(activations, signals), rate)
            updates += 1
            if updates % SWAP_EVERY == 0:
                if two:
                    acting = 1 - acting
                else:
                    for copy, theta in zip(networks[1].parameters(), networks[0].parameters(), strict=True):
                        copy[...] = theta
        if over:
            shown = FIRST_S * S_DECAY ** (updates / 1000) if error_driven else 0.0
            numbers = ",".join(f"{number:.6g}" for number in (epsilon, shown, *means))
            print(f"{episode},{step},{updates},0,0,{length},{length},{numbers},{version}", file=out)
            x, episode, length = env.reset()[0], episode + 1, 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", choices=METHODS, default="coop")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=5000)
    options = parser.parse_args()
    train(options.method, options.seed, options.steps)
