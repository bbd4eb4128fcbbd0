// Where a photograph was taken, for Unity: every call of the interface; axes and stale answers are taken care of. See
// the README beside this.
//
// Needs Google.Protobuf, Grpc.Net.Client and YetAnotherHttpHandler, and the messages that protoc makes of mapless's protos.

using System;
using System.Collections.Generic;
using System.Net.Http;
using System.Net.Sockets;
using System.Threading;
using System.Threading.Tasks;
using Cysharp.Net.Http;
using Google.Protobuf;
using Google.Protobuf.WellKnownTypes;
using Grpc.Core;
using Grpc.Net.Client;
using Mapless.V1;
// Mapless.V1 has messages of the same names.
using Pose = UnityEngine.Pose;
using Quaternion = UnityEngine.Quaternion;
using ScreenOrientation = UnityEngine.ScreenOrientation;
using Vector3 = UnityEngine.Vector3;

namespace Mapless
{
    /// <summary>Where the device was, or why that is not known.</summary>
    public sealed class MaplessAnswer
    {
        /// <summary>The whole response of the server.</summary>
        public LocalizeResponse Response { get; }

        internal MaplessAnswer(LocalizeResponse response)
        {
            Response = response;
        }

        /// <summary>Whether there is a pose; if not, Response.Rejection says why and what would help.</summary>
        public bool IsLocalized => Response.Localization != null;

        /// <summary>
        /// The scene in whose world the pose is, "scenes/hall": the request's, or the one that was found among several.
        /// </summary>
        public string Scene => Response.Scene;

        /// <summary>How sure it is, 0 to 1; 0 where nothing has checked it.</summary>
        public double Trust => IsLocalized && Response.Localization.HasTrust ? Response.Localization.Trust : 0;

        /// <summary>Radius in metres that holds the true position in 95 of 100 cases; infinite where it is unknown.</summary>
        public double Radius95M =>
            Response.Localization?.Accuracy?.Position95M ?? double.PositiveInfinity;

        /// <summary>
        /// Where the scene lies in the session's space: give this pose to the object under which everything stands that is
        /// placed in the scene's coordinates. The answer is of the moment of capture and the device has moved on, but where
        /// the scene lies has not changed since: apply it whenever it comes.
        /// </summary>
        /// <exception cref="InvalidOperationException">There is no pose.</exception>
        public Pose SessionFromWorld()
        {
            if (!IsLocalized)
            {
                throw new InvalidOperationException("not localized: " + Response.Rejection?.Reason);
            }
            Pose worldFromSession = MaplessClient.ToPose(Response.Localization.InAxes.WorldFromSession);
            Quaternion inverse = Quaternion.Inverse(worldFromSession.rotation);
            return new Pose(inverse * -worldFromSession.position, inverse);
        }
    }

    /// <summary>A connection to a mapless server. Use one for all calls, from any thread.</summary>
    public sealed class MaplessClient : IDisposable
    {
        private const string LocalizationService = "mapless.v1.LocalizationService";
        private const string ReferenceService = "mapless.v1.ReferenceService";

        // What a generated stub would hold; by hand it takes no gRPC plugin for protoc.
        private static readonly Method<LocalizeRequest, LocalizeResponse> LocalizeMethod =
            MethodOf(LocalizationService, "Localize", LocalizeRequest.Parser, LocalizeResponse.Parser);
        private static readonly Method<LocalizeRigRequest, LocalizeRigResponse> LocalizeRigMethod =
            MethodOf(LocalizationService, "LocalizeRig", LocalizeRigRequest.Parser, LocalizeRigResponse.Parser);
        private static readonly Method<LocalizeSequenceRequest, LocalizeSequenceResponse> LocalizeSequenceMethod =
            MethodOf(LocalizationService, "LocalizeSequence", LocalizeSequenceRequest.Parser, LocalizeSequenceResponse.Parser);
        private static readonly Method<CreateSceneRequest, CreateSceneResponse> CreateSceneMethod =
            MethodOf(ReferenceService, "CreateScene", CreateSceneRequest.Parser, CreateSceneResponse.Parser);
        private static readonly Method<GetSceneRequest, GetSceneResponse> GetSceneMethod =
            MethodOf(ReferenceService, "GetScene", GetSceneRequest.Parser, GetSceneResponse.Parser);
        private static readonly Method<UpdateSceneRequest, UpdateSceneResponse> UpdateSceneMethod =
            MethodOf(ReferenceService, "UpdateScene", UpdateSceneRequest.Parser, UpdateSceneResponse.Parser);
        private static readonly Method<ListScenesRequest, ListScenesResponse> ListScenesMethod =
            MethodOf(ReferenceService, "ListScenes", ListScenesRequest.Parser, ListScenesResponse.Parser);
        private static readonly Method<DeleteSceneRequest, DeleteSceneResponse> DeleteSceneMethod =
            MethodOf(ReferenceService, "DeleteScene", DeleteSceneRequest.Parser, DeleteSceneResponse.Parser);
        private static readonly Method<CreateReferenceRequest, CreateReferenceResponse> CreateReferenceMethod =
            MethodOf(ReferenceService, "CreateReference", CreateReferenceRequest.Parser, CreateReferenceResponse.Parser);
        private static readonly Method<BatchCreateReferencesRequest, BatchCreateReferencesResponse> BatchCreateReferencesMethod =
            MethodOf(ReferenceService, "BatchCreateReferences", BatchCreateReferencesRequest.Parser, BatchCreateReferencesResponse.Parser);
        private static readonly Method<GetReferenceRequest, GetReferenceResponse> GetReferenceMethod =
            MethodOf(ReferenceService, "GetReference", GetReferenceRequest.Parser, GetReferenceResponse.Parser);
        private static readonly Method<ListReferencesRequest, ListReferencesResponse> ListReferencesMethod =
            MethodOf(ReferenceService, "ListReferences", ListReferencesRequest.Parser, ListReferencesResponse.Parser);
        private static readonly Method<DeleteReferenceRequest, DeleteReferenceResponse> DeleteReferenceMethod =
            MethodOf(ReferenceService, "DeleteReference", DeleteReferenceRequest.Parser, DeleteReferenceResponse.Parser);
        private static readonly Method<RetireReferenceRequest, RetireReferenceResponse> RetireReferenceMethod =
            MethodOf(ReferenceService, "RetireReference", RetireReferenceRequest.Parser, RetireReferenceResponse.Parser);
        private static readonly Method<RestoreReferencesRequest, RestoreReferencesResponse> RestoreReferencesMethod =
            MethodOf(ReferenceService, "RestoreReferences", RestoreReferencesRequest.Parser, RestoreReferencesResponse.Parser);
        private static readonly Method<RestoreReferenceRequest, RestoreReferenceResponse> RestoreReferenceMethod =
            MethodOf(ReferenceService, "RestoreReference", RestoreReferenceRequest.Parser, RestoreReferenceResponse.Parser);
        private static readonly Method<RetrieveReferencesRequest, RetrieveReferencesResponse> RetrieveReferencesMethod =
            MethodOf(ReferenceService, "RetrieveReferences", RetrieveReferencesRequest.Parser, RetrieveReferencesResponse.Parser);
        private static readonly Method<AuditSceneRequest, AuditSceneResponse> AuditSceneMethod =
            MethodOf(ReferenceService, "AuditScene", AuditSceneRequest.Parser, AuditSceneResponse.Parser);
        private static readonly Method<GetSceneReportRequest, GetSceneReportResponse> GetSceneReportMethod =
            MethodOf(ReferenceService, "GetSceneReport", GetSceneReportRequest.Parser, GetSceneReportResponse.Parser);
        private static readonly Method<CheckCoverageRequest, CheckCoverageResponse> CheckCoverageMethod =
            MethodOf(ReferenceService, "CheckCoverage", CheckCoverageRequest.Parser, CheckCoverageResponse.Parser);
        private static readonly Method<LocalizeRequest, LocalizeProgressivelyResponse> LocalizeProgressivelyMethod =
            MethodOf(
                LocalizationService, "LocalizeProgressively", LocalizeRequest.Parser, LocalizeProgressivelyResponse.Parser,
                MethodType.ServerStreaming);
        // grpc.health.v1 in messages that Protobuf has: a text in field 1, and a number in field 1 of the answer.
        private static readonly Method<StringValue, UInt32Value> CheckMethod =
            MethodOf("grpc.health.v1.Health", "Check", StringValue.Parser, UInt32Value.Parser);

        private const uint Serving = 1;
        private const int PageSize = 1000;
        private const int BatchCount = 32;
        private const int BatchBytes = 8 * 1024 * 1024;
        private const int MaxMessageBytes = 32 * 1024 * 1024;

        private const double FirstPauseS = 0.2;
        private const double MaxPauseS = 2;
        private const double LostS = 2;
        private const int CheckAttempts = 4;
        private const double Same = 1e-9; // metres, degrees: errors of rounding where the server normalizes

        private sealed class Server
        {
            public GrpcChannel Channel;
            public CallInvoker Invoker;
            public long LostUntil; // ticks; those that were lost a moment ago are passed over
        }

        private readonly List<Server> servers = new List<Server>();
        private readonly Metadata headers = new Metadata();
        private readonly Random random = new Random();
        private int turns = -1;

        /// <summary>Does not connect yet.</summary>
        /// <param name="address">
        /// "https://host:50051", or "http://..." for a server without TLS; "https://host1:50051,https://host2:50051" of several
        /// that share a store: calls take turns, and pass over a server that is away.
        /// </param>
        /// <param name="token">Sent to the server, if it requires one. Only over https.</param>
        /// <param name="clientId">Which device this is; the server is fair between them.</param>
        /// <param name="handler">
        /// Handler of HTTP/2, of all servers; a YetAnotherHttpHandler for each if null, which uses no proxy. .NET's own handlers
        /// use that of the environment, and NO_PROXY; if all servers are on this machine, this turns it off.
        /// </param>
        public MaplessClient(string address, string token = null, string clientId = null, HttpMessageHandler handler = null)
        {
            string[] addresses = Array.ConvertAll(address.Split(','), one => one.Trim());
            if (handler != null && Array.TrueForAll(addresses, one => new Uri(one).IsLoopback))
            {
                UseNoProxy(handler);
            }
            foreach (string one in addresses)
            {
                var channel = GrpcChannel.ForAddress(one, new GrpcChannelOptions
                {
                    HttpHandler = handler ?? new YetAnotherHttpHandler { Http2Only = true },
                    DisposeHttpClient = true,
                    MaxReceiveMessageSize = MaxMessageBytes,
                    MaxSendMessageSize = MaxMessageBytes,
                });
                servers.Add(new Server { Channel = channel, Invoker = channel.CreateCallInvoker() });
            }
            if (token != null)
            {
                headers.Add("authorization", "Bearer " + token);
            }
            if (clientId != null)
            {
                headers.Add("x-client-id", clientId);
            }
        }

        private static void UseNoProxy(HttpMessageHandler handler)
        {
            if (handler is HttpClientHandler client)
            {
                client.UseProxy = false;
            }
#if NET5_0_OR_GREATER
            if (handler is SocketsHttpHandler sockets)
            {
                sockets.UseProxy = false;
            }
#endif
        }

        /// <summary>Asks where a photograph was taken.</summary>
        /// <param name="scene">"scenes/hall".</param>
        /// <param name="jpeg">The file, its raster as the sensor saw it: not turned to how the device is held.</param>
        /// <param name="intrinsics">Of that raster, in its pixels, (0, 0) the centre of the top-left one.</param>
        /// <param name="sensorPose">
        /// Where that camera was in the session when it took the photograph, not now: keep it with the photograph. Its axes
        /// are the raster's, x right, y up, z forward; SensorPose makes it from the pose of Unity's camera.
        /// </param>
        /// <param name="captureTime">When that was; echoed.</param>
        /// <param name="timeout">
        /// Deadline of the call, until which it is repeated while the server is away, stops or is lost during the answer.
        /// </param>
        /// <param name="cancellation">Ends the call earlier, on the server, too.</param>
        /// <param name="depth">What a depth sensor measured of that raster: DepthMetres makes it; null without.</param>
        /// <exception cref="RpcException">
        /// Unavailable (until the deadline) and ResourceExhausted: try again later, with a newer photograph. Others say what
        /// is wrong.
        /// </exception>
        public async Task<MaplessAnswer> LocalizeAsync(
            string scene,
            byte[] jpeg,
            CameraIntrinsics intrinsics,
            Pose sensorPose,
            DateTime captureTime,
            TimeSpan timeout,
            CancellationToken cancellation = default,
            DepthImage depth = null)
        {
            var request = new LocalizeRequest
            {
                Scene = scene,
                Image = ByteString.CopyFrom(jpeg),
                Intrinsics = intrinsics,
                CaptureTime = Timestamp.FromDateTime(captureTime.ToUniversalTime()),
                SessionFromCamera = ToMessage(sensorPose),
                Options = new LocalizeOptions { Axes = Axes.Unity },
                Depth = depth,
            };
            return new MaplessAnswer(await LocalizeAsync(request, timeout, cancellation).ConfigureAwait(true));
        }

        /// <summary>
        /// As LocalizeAsync, with all options of the request: several scenes, priors, references, several axes. The calls below are likewise those
        /// of the interface, whose comments say what their messages mean. All throw RpcException.
        /// </summary>
        public Task<LocalizeResponse> LocalizeAsync(
            LocalizeRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            string scene = SceneOf(request.Scene, request.Scenes, request.SceneGroup);
            return CallAsync(LocalizeMethod, request, scene, timeout, cancellation);
        }

        /// <summary>
        /// As LocalizeAsync; onBetter gets each better answer before the final one, in the caller's context, none or one mostly:
        /// localizations in which the server has little trust, and first, where Options.AllowCoarse is set, a coarse pose that
        /// nothing has checked.
        /// </summary>
        public async Task<LocalizeResponse> LocalizeProgressivelyAsync(
            LocalizeRequest request,
            Action<MaplessAnswer> onBetter,
            TimeSpan timeout,
            CancellationToken cancellation = default)
        {
            var attempts = new Attempts(this, timeout, cancellation);
            bool hadBetter = false, isRepeated = false;
            while (true)
            {
                Server server = NextServer();
                CallOptions options = OptionsOf(
                    SceneOf(request.Scene, request.Scenes, request.SceneGroup), attempts.Deadline, cancellation);
                try
                {
                    using (var call = server.Invoker.AsyncServerStreamingCall(LocalizeProgressivelyMethod, null, options, request))
                    {
                        while (await call.ResponseStream.MoveNext(cancellation).ConfigureAwait(true))
                        {
                            LocalizeProgressivelyResponse message = call.ResponseStream.Current;
                            if (message.IsFinal)
                            {
                                return message.Answer;
                            }
                            if (!isRepeated)
                            {
                                hadBetter = true;
                                onBetter?.Invoke(new MaplessAnswer(message.Answer));
                            }
                        }
                    }
                }
                catch (RpcException error) when (attempts.CanRepeat(server, error))
                {
                    await attempts.PauseAsync().ConfigureAwait(true);
                    isRepeated = hadBetter; // what comes earlier could be worse than what was given already
                    continue;
                }
                throw new RpcException(new Status(StatusCode.Internal, "the stream ended before the answer"));
            }
        }

        /// <summary>Photographs of several cameras of one moment.</summary>
        public Task<LocalizeRigResponse> LocalizeRigAsync(
            LocalizeRigRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            string scene = SceneOf(request.Scene, request.Scenes, request.SceneGroup);
            return CallAsync(LocalizeRigMethod, request, scene, timeout, cancellation);
        }

        /// <summary>Photographs of a walk, with tracked poses.</summary>
        public Task<LocalizeSequenceResponse> LocalizeSequenceAsync(
            LocalizeSequenceRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            string scene = SceneOf(request.Scene, request.Scenes, request.SceneGroup);
            return CallAsync(LocalizeSequenceMethod, request, scene, timeout, cancellation);
        }

        /// <summary>Whether the server takes calls now; false while it starts or drains. Four attempts, in 1.4 s.</summary>
        public async Task<bool> IsServingAsync(TimeSpan timeout, CancellationToken cancellation = default)
        {
            var answer = await CallAsync(
                CheckMethod, new StringValue(), null, timeout, cancellation, null, CheckAttempts).ConfigureAwait(true);
            return answer.Value == Serving;
        }

        /// <summary>Creates a scene.</summary>
        public async Task<Scene> CreateSceneAsync(
            CreateSceneRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            string scene = "scenes/" + request.SceneId;
            Func<RpcException, TimeSpan, Task<CreateSceneResponse>> find = async (error, left) =>
            {
                Scene stored = await GetSceneAsync(scene, left, cancellation).ConfigureAwait(true);
                return IsSame(request, stored) ? new CreateSceneResponse { Scene = stored } : null;
            };
            return (await CallAsync(CreateSceneMethod, request, scene, timeout, cancellation, find).ConfigureAwait(true)).Scene;
        }

        /// <summary>A scene, "scenes/hall".</summary>
        public async Task<Scene> GetSceneAsync(string scene, TimeSpan timeout, CancellationToken cancellation = default)
        {
            var request = new GetSceneRequest { Name = scene };
            return (await CallAsync(GetSceneMethod, request, scene, timeout, cancellation).ConfigureAwait(true)).Scene;
        }

        /// <summary>Changes properties of a scene; the answer has what contradicts them.</summary>
        public Task<UpdateSceneResponse> UpdateSceneAsync(
            UpdateSceneRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            return CallAsync(UpdateSceneMethod, request, request.Scene.Name, timeout, cancellation);
        }

        /// <summary>All scenes; the timeout is that of each page.</summary>
        public async Task<List<Scene>> ListScenesAsync(TimeSpan timeout, CancellationToken cancellation = default)
        {
            var scenes = new List<Scene>();
            var request = new ListScenesRequest { PageSize = PageSize };
            do
            {
                var page = await CallAsync(ListScenesMethod, request, null, timeout, cancellation).ConfigureAwait(true);
                scenes.AddRange(page.Scenes);
                request.PageToken = page.NextPageToken;
            }
            while (request.PageToken.Length > 0);
            return scenes;
        }

        /// <summary>Deletes a scene and its references.</summary>
        public Task DeleteSceneAsync(string scene, TimeSpan timeout, CancellationToken cancellation = default)
        {
            var request = new DeleteSceneRequest { Name = scene };
            return CallAsync(DeleteSceneMethod, request, scene, timeout, cancellation, Gone(new DeleteSceneResponse()));
        }

        /// <summary>Stores a photograph with its intrinsics and pose.</summary>
        public Task<CreateReferenceResponse> CreateReferenceAsync(
            CreateReferenceRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            Func<RpcException, TimeSpan, Task<CreateReferenceResponse>> find = async (error, left) =>
            {
                Reference stored = await StoredAsync(request.Scene, request, left, cancellation).ConfigureAwait(true);
                return stored == null ? null : new CreateReferenceResponse { Reference = stored };
            };
            return CallAsync(CreateReferenceMethod, request, request.Scene, timeout, cancellation, find);
        }

        /// <summary>Stores many, in messages of about 8 MB; each is stored whole or not at all.</summary>
        /// <param name="scene">"scenes/hall".</param>
        /// <param name="references">Without their scene.</param>
        /// <param name="timeout">Of each message: its features are computed before it returns; minutes.</param>
        /// <param name="onProgress">Gets the number stored so far.</param>
        /// <param name="cancellation">Ends it; what is stored remains.</param>
        public async Task<List<Reference>> AddReferencesAsync(
            string scene,
            IEnumerable<CreateReferenceRequest> references,
            TimeSpan timeout,
            Action<int> onProgress = null,
            CancellationToken cancellation = default)
        {
            var stored = new List<Reference>();
            var batch = new BatchCreateReferencesRequest { Scene = scene };
            var left = new Queue<CreateReferenceRequest>(references);
            while (left.Count > 0)
            {
                batch.Requests.Add(left.Dequeue());
                bool isFull = left.Count == 0 || batch.Requests.Count == BatchCount
                    || batch.CalculateSize() + left.Peek().CalculateSize() > BatchBytes;
                if (isFull)
                {
                    Func<RpcException, TimeSpan, Task<BatchCreateReferencesResponse>> find = async (error, remaining) =>
                    {
                        var found = new BatchCreateReferencesResponse();
                        foreach (CreateReferenceRequest wanted in batch.Requests)
                        {
                            Reference one = await StoredAsync(scene, wanted, remaining, cancellation).ConfigureAwait(true);
                            if (one == null)
                            {
                                return null;
                            }
                            found.References.Add(one);
                        }
                        return found;
                    };
                    var done = await CallAsync(BatchCreateReferencesMethod, batch, scene, timeout, cancellation, find)
                        .ConfigureAwait(true);
                    stored.AddRange(done.References);
                    onProgress?.Invoke(stored.Count);
                    batch.Requests.Clear();
                }
            }
            return stored;
        }

        /// <summary>A reference, "scenes/hall/references/a".</summary>
        public async Task<Reference> GetReferenceAsync(
            string reference, bool includeImage, TimeSpan timeout, CancellationToken cancellation = default)
        {
            var request = new GetReferenceRequest { Name = reference, IncludeImage = includeImage };
            var answer = await CallAsync(GetReferenceMethod, request, SceneOf(reference), timeout, cancellation)
                .ConfigureAwait(true);
            return answer.Reference;
        }

        /// <summary>All references of a scene, without photographs; the timeout is that of each page.</summary>
        public async Task<List<Reference>> ListReferencesAsync(
            string scene, TimeSpan timeout, CancellationToken cancellation = default)
        {
            var references = new List<Reference>();
            var request = new ListReferencesRequest { Scene = scene, PageSize = PageSize };
            do
            {
                var page = await CallAsync(ListReferencesMethod, request, scene, timeout, cancellation).ConfigureAwait(true);
                references.AddRange(page.References);
                request.PageToken = page.NextPageToken;
            }
            while (request.PageToken.Length > 0);
            return references;
        }

        /// <summary>Deletes a reference.</summary>
        public Task DeleteReferenceAsync(string reference, TimeSpan timeout, CancellationToken cancellation = default)
        {
            var request = new DeleteReferenceRequest { Name = reference };
            var gone = Gone(new DeleteReferenceResponse());
            return CallAsync(DeleteReferenceMethod, request, SceneOf(reference), timeout, cancellation, gone);
        }

        /// <summary>Has a reference not chosen for photographs any more.</summary>
        public async Task<Reference> RetireReferenceAsync(
            string reference, TimeSpan timeout, CancellationToken cancellation = default)
        {
            var request = new RetireReferenceRequest { Name = reference };
            var answer = await CallAsync(RetireReferenceMethod, request, SceneOf(reference), timeout, cancellation)
                .ConfigureAwait(true);
            return answer.Reference;
        }

        /// <summary>Has all retired references of a scene chosen again, or some of them.</summary>
        public Task<RestoreReferencesResponse> RestoreReferencesAsync(
            RestoreReferencesRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            return CallAsync(RestoreReferencesMethod, request, request.Scene, timeout, cancellation);
        }

        /// <summary>Has a retired reference chosen again.</summary>
        public async Task<Reference> RestoreReferenceAsync(
            string reference, TimeSpan timeout, CancellationToken cancellation = default)
        {
            var request = new RestoreReferenceRequest { Name = reference };
            var answer = await CallAsync(RestoreReferenceMethod, request, SceneOf(reference), timeout, cancellation)
                .ConfigureAwait(true);
            return answer.Reference;
        }

        /// <summary>The references that a photograph resembles.</summary>
        public Task<RetrieveReferencesResponse> RetrieveReferencesAsync(
            RetrieveReferencesRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            return CallAsync(RetrieveReferencesMethod, request, request.Scene, timeout, cancellation);
        }

        /// <summary>One page of an audit; NextPageToken of the answer is for the next request.</summary>
        public Task<AuditSceneResponse> AuditSceneAsync(
            AuditSceneRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            return CallAsync(AuditSceneMethod, request, request.Scene, timeout, cancellation);
        }

        /// <summary>How photographs of a scene were answered, and where references would help.</summary>
        public Task<GetSceneReportResponse> GetSceneReportAsync(
            GetSceneReportRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            return CallAsync(GetSceneReportMethod, request, request.Scene, timeout, cancellation);
        }

        /// <summary>Whether a photograph at a pose would be localized.</summary>
        public Task<CheckCoverageResponse> CheckCoverageAsync(
            CheckCoverageRequest request, TimeSpan timeout, CancellationToken cancellation = default)
        {
            return CallAsync(CheckCoverageMethod, request, request.Scene, timeout, cancellation);
        }

        /// <summary>
        /// Makes a call, and repeats it until its deadline. Where the answer to a change was lost, find gets the error of the
        /// next attempt and the time left: it returns the lost response, or null if the error is right.
        /// </summary>
        private async Task<TResponse> CallAsync<TRequest, TResponse>(
            Method<TRequest, TResponse> method,
            TRequest request,
            string scene,
            TimeSpan timeout,
            CancellationToken cancellation,
            Func<RpcException, TimeSpan, Task<TResponse>> find = null,
            int mostAttempts = int.MaxValue)
            where TRequest : class
            where TResponse : class
        {
            var attempts = new Attempts(this, timeout, cancellation, mostAttempts);
            while (true)
            {
                Server server = NextServer();
                CallOptions options = OptionsOf(scene, attempts.Deadline, cancellation);
                RpcException failure;
                try
                {
                    using (var call = server.Invoker.AsyncUnaryCall(method, null, options, request))
                    {
                        return await call.ResponseAsync.ConfigureAwait(true);
                    }
                }
                catch (RpcException error)
                {
                    failure = error;
                }
                bool isConflict = failure.StatusCode == StatusCode.AlreadyExists || failure.StatusCode == StatusCode.NotFound;
                if (isConflict && find != null && attempts.MayBeDone)
                {
                    TResponse found = await find(failure, attempts.Left).ConfigureAwait(true);
                    if (found != null)
                    {
                        return found;
                    }
                }
                if (!attempts.CanRepeat(server, failure))
                {
                    throw failure;
                }
                await attempts.PauseAsync().ConfigureAwait(true);
            }
        }

        private Server NextServer()
        {
            int first = (Interlocked.Increment(ref turns) & int.MaxValue) % servers.Count;
            long now = DateTime.UtcNow.Ticks;
            Server best = null;
            for (int i = 0; i < servers.Count; i++)
            {
                Server one = servers[(first + i) % servers.Count];
                if (best == null || Math.Max(one.LostUntil, now) < Math.Max(best.LostUntil, now))
                {
                    best = one;
                }
            }
            return best;
        }

        /// <summary>The attempts of one call, which share its deadline.</summary>
        private sealed class Attempts
        {
            private readonly MaplessClient client;
            private readonly CancellationToken cancellation;
            private readonly int most;
            private int count;
            private double pauseS;

            public DateTime Deadline { get; }

            /// <summary>Whether an attempt whose answer was lost may have been carried out.</summary>
            public bool MayBeDone { get; private set; }

            public TimeSpan Left => TimeSpan.FromSeconds(Math.Max((Deadline - DateTime.UtcNow).TotalSeconds, 0.001));

            public Attempts(MaplessClient client, TimeSpan timeout, CancellationToken cancellation, int most = int.MaxValue)
            {
                this.client = client;
                this.cancellation = cancellation;
                this.most = most;
                Deadline = DateTime.UtcNow + timeout;
            }

            /// <summary>Whether another attempt follows a failed one, after a pause.</summary>
            public bool CanRepeat(Server server, RpcException error)
            {
                if (!IsLost(error) || cancellation.IsCancellationRequested || ++count >= most)
                {
                    return false;
                }
                server.LostUntil = DateTime.UtcNow.AddSeconds(LostS).Ticks;
                double leftS = (Deadline - DateTime.UtcNow).TotalSeconds;
                pauseS = Math.Min(FirstPauseS * Math.Pow(2, Math.Min(count - 1, 10)), MaxPauseS);
                double jitter;
                lock (client.random)
                {
                    jitter = 0.8 + 0.4 * client.random.NextDouble();
                }
                // A server that returns shortly before the deadline is found, too.
                pauseS = Math.Max(Math.Min(pauseS, leftS / 2), FirstPauseS) * jitter;
                MayBeDone |= pauseS < leftS && !IsUnsent(error);
                return pauseS < leftS;
            }

            /// <summary>
            /// Whether no connection was made, so that the call has reached no server: by the system's error, where .NET made the
            /// connection, or by the words of YetAnotherHttpHandler.
            /// </summary>
            private static bool IsUnsent(RpcException error)
            {
                for (Exception cause = error.Status.DebugException; cause != null; cause = cause.InnerException)
                {
                    if (cause is SocketException socket && Array.IndexOf(Unconnected, socket.SocketErrorCode) >= 0)
                    {
                        return true;
                    }
                }
                return Array.Exists(UnconnectedSigns, sign => error.Status.Detail.IndexOf(sign, StringComparison.Ordinal) >= 0);
            }

            private static readonly SocketError[] Unconnected =
            {
                SocketError.ConnectionRefused, SocketError.HostNotFound, SocketError.TryAgain, SocketError.NoData,
                SocketError.HostUnreachable, SocketError.NetworkUnreachable, SocketError.AddressNotAvailable,
            };

            private static readonly string[] UnconnectedSigns =
            {
                "client error (Connect)", "error trying to connect", "Error connecting to subchannel", "Connection refused",
            };

            public Task PauseAsync()
            {
                return Task.Delay(TimeSpan.FromSeconds(pauseS), cancellation);
            }

            /// <summary>
            /// Whether the server is away, stops, or was lost during the answer: also where gRPC has made another status of a
            /// connection that broke. The server's own errors have its request id.
            /// </summary>
            private static bool IsLost(RpcException error)
            {
                switch (error.StatusCode)
                {
                    case StatusCode.Unavailable:
                    case StatusCode.Cancelled:
                        return true;
                    case StatusCode.Internal:
                    case StatusCode.Unknown:
                        foreach (Metadata.Entry entry in error.Trailers)
                        {
                            if (entry.Key == "x-request-id")
                            {
                                return false;
                            }
                        }
                        string[] signs =
                        {
                            "Error starting gRPC call", "Error reading next message", "RST_STREAM", "GOAWAY",
                            "connection", "status code: 50",
                        };
                        return Array.Exists(signs, sign => error.Status.Detail.IndexOf(sign, StringComparison.Ordinal) >= 0);
                    default:
                        return false;
                }
            }
        }

        /// <summary>What was to be deleted is gone, by an attempt whose answer was lost.</summary>
        private static Func<RpcException, TimeSpan, Task<TResponse>> Gone<TResponse>(TResponse response)
            where TResponse : class
        {
            return (error, left) => Task.FromResult(error.StatusCode == StatusCode.NotFound ? response : null);
        }

        /// <summary>The stored reference if it is the one that was to be stored, else null.</summary>
        private async Task<Reference> StoredAsync(
            string scene, CreateReferenceRequest wanted, TimeSpan left, CancellationToken cancellation)
        {
            string name = scene + "/references/" + wanted.ReferenceId;
            bool hasDepth = wanted.Reference.Depth != null; // which comes back with the photograph only
            Reference stored = await GetReferenceAsync(name, hasDepth, left, cancellation).ConfigureAwait(true);
            string mask = wanted.Reference.HasMask ? Sha256Of(wanted.Reference.Mask) : "";
            bool isSame = string.Equals(Sha256Of(wanted.Reference.Image), stored.ImageSha256, StringComparison.OrdinalIgnoreCase)
                && string.Equals(mask, stored.MaskSha256, StringComparison.OrdinalIgnoreCase)
                && (hasDepth ? IsSame(wanted.Reference.Depth, stored.Depth) : stored.DepthSha256.Length == 0)
                && wanted.Reference.Intrinsics.Equals(stored.Intrinsics)
                && IsSame(wanted.Reference.WorldFromCamera, stored.WorldFromCamera);
            return isSame ? stored : null;
        }

        private static string Sha256Of(ByteString bytes)
        {
            using (var hash = System.Security.Cryptography.SHA256.Create())
            {
                return BitConverter.ToString(hash.ComputeHash(bytes.ToByteArray())).Replace("-", "");
            }
        }

        private static bool IsSame(DepthImage wanted, DepthImage stored)
        {
            return stored != null && wanted.Png.Equals(stored.Png) && wanted.Float32.Equals(stored.Float32)
                && wanted.UnitM.Equals(stored.UnitM) && wanted.Sensor == stored.Sensor
                && wanted.Confidence.Equals(stored.Confidence);
        }

        private static bool IsSame(CreateSceneRequest wanted, Scene stored)
        {
            return stored.Generation == 1 && stored.ArbitraryUnit == wanted.ArbitraryUnit
                && IsSame(wanted.Datum, stored.Datum) && IsSame(wanted.DownInWorld, stored.DownInWorld);
        }

        private static bool IsSame(Datum wanted, Datum stored)
        {
            if (wanted == null || stored == null)
            {
                return wanted == stored;
            }
            var none = new V1.Quaternion { W = 1 };
            return IsNear(wanted.LatitudeDeg, stored.LatitudeDeg) && IsNear(wanted.LongitudeDeg, stored.LongitudeDeg)
                && IsNear(wanted.HeightM, stored.HeightM)
                && IsSame(wanted.EnuFromWorld ?? none, stored.EnuFromWorld ?? none);
        }

        private static bool IsSame(V1.Vector3 wanted, V1.Vector3 stored)
        {
            if (wanted == null || stored == null)
            {
                return wanted == stored;
            }
            double w = Math.Sqrt(wanted.X * wanted.X + wanted.Y * wanted.Y + wanted.Z * wanted.Z);
            double s = Math.Sqrt(stored.X * stored.X + stored.Y * stored.Y + stored.Z * stored.Z);
            return IsNear(wanted.X / w, stored.X / s) && IsNear(wanted.Y / w, stored.Y / s) && IsNear(wanted.Z / w, stored.Z / s);
        }

        private static bool IsSame(RigidTransform wanted, RigidTransform stored)
        {
            V1.Vector3 w = wanted.TranslationM, s = stored.TranslationM;
            return IsSame(wanted.Rotation, stored.Rotation) && IsNear(w.X, s.X) && IsNear(w.Y, s.Y) && IsNear(w.Z, s.Z);
        }

        private static bool IsSame(V1.Quaternion a, V1.Quaternion b)
        {
            double both = a.X * b.X + a.Y * b.Y + a.Z * b.Z + a.W * b.W;
            double squares = (a.X * a.X + a.Y * a.Y + a.Z * a.Z + a.W * a.W) * (b.X * b.X + b.Y * b.Y + b.Z * b.Z + b.W * b.W);
            return Math.Abs(both) > (1 - 1e-15) * Math.Sqrt(squares); // q and -q turn alike
        }

        private static bool IsNear(double a, double b)
        {
            return Math.Abs(a - b) <= Same;
        }

        private CallOptions OptionsOf(string scene, DateTime deadline, CancellationToken cancellation)
        {
            var ofCall = new Metadata();
            if (!string.IsNullOrEmpty(scene))
            {
                ofCall.Add("x-mapless-scene", scene); // by it, a load balancer finds the server that has it in memory
            }
            foreach (Metadata.Entry header in headers)
            {
                ofCall.Add(header);
            }
            return new CallOptions(ofCall, deadline, cancellation);
        }

        // Of several scenes the first by name, of a group its labels: calls for the same scenes come to one server.
        private static string SceneOf(string scene, IEnumerable<string> several, SceneGroup group)
        {
            if (group != null)
            {
                var labels = new List<string>();
                foreach (var label in new SortedDictionary<string, string>(group.Labels, StringComparer.Ordinal))
                {
                    labels.Add(Uri.EscapeDataString(label.Key) + "=" + Uri.EscapeDataString(label.Value).Replace("%20", "+"));
                }
                string query = string.Join("&", labels);
                return query.Length <= 200 ? "scenes?" + query : null;
            }
            var scenes = new List<string>(several);
            scenes.Sort(StringComparer.Ordinal);
            return scenes.Count > 0 ? scenes[0] : scene;
        }

        private static string SceneOf(string reference)
        {
            int end = reference.IndexOf("/references/", StringComparison.Ordinal);
            return end < 0 ? null : reference.Substring(0, end);
        }

        private static Method<TRequest, TResponse> MethodOf<TRequest, TResponse>(
            string service,
            string name,
            MessageParser<TRequest> requests,
            MessageParser<TResponse> responses,
            MethodType type = MethodType.Unary)
            where TRequest : class, IMessage<TRequest>
            where TResponse : class, IMessage<TResponse>
        {
            return new Method<TRequest, TResponse>(
                type,
                service,
                name,
                Marshallers.Create(message => message.ToByteArray(), requests.ParseFrom),
                Marshallers.Create(message => message.ToByteArray(), responses.ParseFrom));
        }

        /// <summary>
        /// Depth in metres for LocalizeRequest.Depth and Reference.Depth, of the photograph's camera, scaled, row by row; 0, NaN
        /// and infinity are no value. The rows of a Texture2D begin at the bottom, those of an XRCpuImage at the top.
        /// </summary>
        /// <exception cref="ArgumentException">There are not width times height values.</exception>
        public static DepthImage DepthMetres(
            float[] metres, int width, int height, DepthSensor sensor = DepthSensor.PhoneLidar, bool bottomRowFirst = false)
        {
            if (width < 1 || height < 1 || metres.Length != width * height)
            {
                throw new ArgumentException($"a depth of {width}x{height} cannot have {metres.Length} values");
            }
            int rowBytes = 4 * width;
            var bytes = new byte[rowBytes * height];
            for (int row = 0; row < height; row++)
            {
                int from = bottomRowFirst ? height - 1 - row : row;
                Buffer.BlockCopy(metres, rowBytes * from, bytes, rowBytes * row, rowBytes);
            }
            return new DepthImage
            {
                Float32 = ByteString.CopyFrom(bytes), WidthPx = width, HeightPx = height, UnitM = 1, Sensor = sensor,
            };
        }

        /// <summary>
        /// Metres of the plane of an XRCpuImage, as AROcclusionManager gives it: DepthFloat32 (ARKit) or DepthUint16 (ARCore),
        /// which is millimetres.
        /// </summary>
        /// <exception cref="ArgumentException">The plane has fewer bytes than its rows need.</exception>
        public static float[] DepthPlane(byte[] plane, int rowStride, int width, int height, bool isFloat32)
        {
            int size = isFloat32 ? 4 : 2;
            if (rowStride < size * width || plane.Length < rowStride * (height - 1) + size * width)
            {
                throw new ArgumentException($"a depth of {width}x{height} with rows of {rowStride} bytes cannot have {plane.Length} bytes");
            }
            var metres = new float[width * height];
            for (int i = 0; i < metres.Length; i++)
            {
                int at = rowStride * (i / width) + size * (i % width);
                metres[i] = isFloat32 ? BitConverter.ToSingle(plane, at) : BitConverter.ToUInt16(plane, at) / 1000f;
            }
            return metres;
        }

        /// <summary>
        /// The pose of the sensor's raster, of that of Unity's camera, which turns with the display. For phones and tablets
        /// whose rear camera sees upright when they are held in LandscapeLeft, which is nearly all; glasses have nothing to
        /// turn.
        /// </summary>
        public static Pose SensorPose(Pose camera, ScreenOrientation orientation)
        {
            return new Pose(camera.position, camera.rotation * Quaternion.Euler(0, 0, DegreesToSensor(orientation)));
        }

        private static float DegreesToSensor(ScreenOrientation orientation)
        {
            switch (orientation)
            {
                case ScreenOrientation.Portrait: return -90;
                case ScreenOrientation.LandscapeRight: return 180;
                case ScreenOrientation.PortraitUpsideDown: return 90;
                default: return 0;
            }
        }

        internal static RigidTransform ToMessage(Pose pose)
        {
            Quaternion q = pose.rotation;
            Vector3 p = pose.position;
            return new RigidTransform
            {
                Rotation = new V1.Quaternion { X = q.x, Y = q.y, Z = q.z, W = q.w },
                TranslationM = new V1.Vector3 { X = p.x, Y = p.y, Z = p.z },
            };
        }

        internal static Pose ToPose(RigidTransform transform)
        {
            V1.Quaternion q = transform.Rotation;
            V1.Vector3 p = transform.TranslationM;
            return new Pose(
                new Vector3((float)p.X, (float)p.Y, (float)p.Z),
                new Quaternion((float)q.X, (float)q.Y, (float)q.Z, (float)q.W));
        }

        /// <summary>Ends the connection; calls still running fail.</summary>
        public void Dispose()
        {
            foreach (Server server in servers)
            {
                server.Channel.Dispose();
            }
        }
    }
}
