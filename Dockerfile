# One image for the machines of a Ray cluster and for the command that uses them: see compose.yaml.
FROM python:3.12-slim

# KubeRay asks a container how it is with wget, and Ray's dashboard answers.
RUN apt-get update && apt-get install --yes --no-install-recommends wget && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home qfolio && install --directory --owner qfolio /work
WORKDIR /opt/qfolio
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN pip install --no-cache-dir ".[ray]" "ray[default]"

# The cache lies where any user may write, because the user may be another one (--user).
ENV QFOLIO_CACHE=/tmp/qfolio RAY_USAGE_STATS_ENABLED=0
USER qfolio
WORKDIR /work
ENTRYPOINT ["qfolio"]
