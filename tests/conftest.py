"""What all tests share."""

import torch

torch.set_num_threads(1)  # the tests' tensors are small: more threads gain nothing and collapse on a busy machine
