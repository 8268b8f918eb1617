{{/* What all objects share: names, labels, and what containers may. */}}

{{- define "photonfarm.name" -}}
{{- ternary .Release.Name (printf "%s-photonfarm" .Release.Name) (contains "photonfarm" .Release.Name) | trunc 40 | trimSuffix "-" -}}
{{- end -}}

{{/* The labels by which objects are selected: dict "root" $ "component" NAME */}}
{{- define "photonfarm.selector" -}}
app.kubernetes.io/name: photonfarm
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end -}}

{{- define "photonfarm.labels" -}}
{{ include "photonfarm.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ .root.Chart.Name }}-{{ .root.Chart.Version }}
{{- end -}}

{{/* An image of this repository: dict "root" $ "image" redis|renderer|trainer */}}
{{- define "photonfarm.image" -}}
image: {{ .root.Values.image.registry }}/photonfarm/{{ .image }}:{{ .root.Values.image.tag | default .root.Chart.AppVersion }}
imagePullPolicy: {{ .root.Values.image.pullPolicy }}
{{- end -}}

{{- define "photonfarm.secret" -}}
{{- .Values.redis.existingSecret | default (printf "%s-redis" (include "photonfarm.name" .)) -}}
{{- end -}}

{{/* What every pod has: no token, an unprivileged user, who owns the volumes' files. */}}
{{- define "photonfarm.pod" -}}
serviceAccountName: {{ .Values.serviceAccount }}
automountServiceAccountToken: false
enableServiceLinks: false
{{- with .Values.image.pullSecrets }}
imagePullSecrets:
  {{- range . }}
  - name: {{ . }}
  {{- end }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: {{ .Values.user.uid }}
  runAsGroup: {{ .Values.user.gid }}
  fsGroup: {{ .Values.user.gid }}
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile: { type: RuntimeDefault }
{{- end -}}

{{- define "photonfarm.container" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: { drop: [ALL] }
{{- end -}}

{{/* The store, Redis and the caches, for photonfarm's own containers. */}}
{{- define "photonfarm.environment" -}}
- { name: PHOTONFARM_STORE, value: {{ .Values.bucket.url | default "/data/store" | quote }} }
- { name: PHOTONFARM_REDIS_URL, value: "redis://{{ include "photonfarm.name" . }}-redis:6379/0" }
- { name: PHOTONFARM_REDIS_PASSWORD_FILE, value: /run/photonfarm/redis_password }
- { name: PHOTONFARM_SCENES, value: /scenes }
- { name: HOME, value: /tmp }
- { name: DRJIT_CACHE_DIR, value: {{ ternary "/cache/kernels" "/data/kernels" (ne .Values.bucket.url "") }} } # compiled once for all workers of the volume
{{- if .Values.bucket.url }}
- { name: PHOTONFARM_CACHE, value: /cache }
- { name: PHOTONFARM_CACHE_GB, value: {{ .Values.bucket.cacheGB | quote }} }
{{- end }}
{{- end -}}

{{/* Access to the bucket, if there is one: dict "root" $ */}}
{{- define "photonfarm.bucketAccess" -}}
{{- if and .Values.bucket.url .Values.bucket.secret }}
envFrom:
  - secretRef: { name: {{ .Values.bucket.secret }} }
{{- end }}
{{- end -}}

{{/* dict "root" $ "data" whether /data is needed also with a bucket */}}
{{- define "photonfarm.mounts" -}}
- { name: tmp, mountPath: /tmp }
- { name: password, mountPath: /run/photonfarm, readOnly: true }
{{- if or .data (not .root.Values.bucket.url) }}
- { name: data, mountPath: /data }
{{- end }}
{{- if .root.Values.bucket.url }}
- { name: cache, mountPath: /cache }
{{- end }}
{{- if .root.Values.scenes.existingClaim }}
- { name: scenes, mountPath: /scenes, readOnly: true }
{{- end }}
{{- end -}}

{{- define "photonfarm.volumes" -}}
- { name: tmp, emptyDir: { sizeLimit: 1Gi } }
{{ include "photonfarm.passwordVolume" .root }}
{{- if or .data (not .root.Values.bucket.url) }}
- name: data
  persistentVolumeClaim: { claimName: {{ .root.Values.data.existingClaim | default (printf "%s-data" (include "photonfarm.name" .root)) }} }
{{- end }}
{{- if .root.Values.bucket.url }}
- { name: cache, emptyDir: { sizeLimit: {{ printf "%dGi" (add .root.Values.bucket.cacheGB 10) }} } }
{{- end }}
{{- with .root.Values.scenes.existingClaim }}
- name: scenes
  persistentVolumeClaim: { claimName: {{ . }}, readOnly: true }
{{- end }}
{{- end -}}

{{- define "photonfarm.passwordVolume" -}}
- name: password
  secret:
    secretName: {{ include "photonfarm.secret" . }}
    defaultMode: 292 # 0444: who reaches the folder is said by who mounts it
    items: [{ key: redis_password, path: redis_password }]
{{- end -}}

{{/* Resources, with GPUs: .Values.renderer or .Values.trainer */}}
{{- define "photonfarm.resources" -}}
{{- $resources := deepCopy .resources -}}
{{- if .gpus -}}
{{- $_ := set $resources "limits" (merge (dict .gpuResource .gpus) ($resources.limits | default dict)) -}}
{{- end -}}
resources: {{- toYaml $resources | nindent 2 }}
{{- end -}}

{{/* Where pods may run: .Values.renderer or .Values.trainer */}}
{{- define "photonfarm.placement" -}}
{{- with .runtimeClass }}
runtimeClassName: {{ . }}
{{- end }}
{{- with .nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .tolerations }}
tolerations: {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}
