# docker build --tag bevcli .                    # CPU
# docker build --tag bevcli:gpu --build-arg BASE=nvidia/cuda:12.8.1-base-ubuntu24.04 \
#     --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128 .
# docker run --rm --volume "$PWD:/drives" bevcli demo --no-view        # docs/containers.md
ARG BASE=python:3.13-slim
FROM ${BASE}

# The base of CUDA has no Python, the other one has its own.
RUN command -v python3 || (apt-get update && apt-get install --yes --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*)
RUN python3 -m venv /opt/bevcli
ENV PATH=/opt/bevcli/bin:$PATH PIP_NO_CACHE_DIR=1

# PyTorch first: its layer stays when bevcli changes.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY constraints.txt /source/
RUN pip install --constraint /source/constraints.txt torch --index-url ${TORCH_INDEX}
COPY . /source
RUN pip install --constraint /source/constraints.txt /source && rm -rf /source

# Files that a run writes belong to this user; `docker run --user` names another.
RUN useradd --create-home --uid 1001 driver && mkdir /drives && chown driver /drives
USER driver
WORKDIR /drives
ENTRYPOINT ["bevcli"]
CMD ["--help"]
