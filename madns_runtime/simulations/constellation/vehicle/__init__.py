"""The framework's side of an agent's board: holds truth, hands out what flight software may see."""
