"""Several processes that train one model together, one a GPU, on torch.distributed."""
