import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread():
    """More only get in each other's way on tensors so small; a training changes both settings."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(False)
