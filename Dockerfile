# Both of README's commands in a container: docker build -t apprenticeship . && docker run --rm apprenticeship
FROM python:3.13-slim
RUN apt-get update && apt-get install --yes --no-install-recommends git make && rm -rf /var/lib/apt/lists/*
WORKDIR /project
COPY . .
# The CPU build of torch: the default one on Linux brings 4 GB of libraries for graphics cards.
RUN python3 -m venv .venv && .venv/bin/python -m pip install --no-cache-dir "$(grep '^torch==' environment.txt)" \
    --index-url https://download.pytorch.org/whl/cpu && make setup
CMD ["sh", "-c", "make test && make reports"]
