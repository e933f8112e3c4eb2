"""The paper, Sections 3 and 4.2: features, LSTM policy, REINFORCE, maximum-entropy IRL, evaluation; and our additions to them."""
