# The images of docker-compose.yml: build one with --target redis, renderer or trainer.
# They run as an unprivileged user; the store, the queue's journal and the scenes come in as volumes.

FROM python:3.11-slim-bookworm AS redis
RUN apt-get update \
    && apt-get install -y --no-install-recommends redis-server \
    && rm -rf /var/lib/apt/lists/* \
    && install -d -o redis -g redis /data
USER redis
VOLUME /data
# The queue is disposable, but a journal saves the workers a reconcile; nothing may be evicted from a queue.
CMD ["redis-server", "--dir", "/data", "--save", "", "--appendonly", "yes", "--appendfsync", "everysec", \
     "--maxmemory-policy", "noeviction", "--protected-mode", "no", "--daemonize", "no"]

FROM python:3.11-slim-bookworm AS shared
ENV PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore PYTHONUNBUFFERED=1
RUN useradd --uid 1000 --create-home photonfarm
WORKDIR /build
COPY constraints.txt ./
COPY shared shared
RUN pip install -q -c constraints.txt ./shared

FROM shared AS renderer
RUN apt-get update \
    && apt-get install -y --no-install-recommends libllvm19 libatomic1 \
    && rm -rf /var/lib/apt/lists/*
COPY services/renderer services/renderer
RUN pip install -q -c constraints.txt ./services/renderer
WORKDIR /home/photonfarm
USER photonfarm
CMD ["photonfarm", "work"]

FROM shared AS trainer
COPY services/trainer services/trainer
RUN pip install -q -c constraints.txt ./services/trainer
WORKDIR /home/photonfarm
USER photonfarm
CMD ["photonfarm", "train"]
