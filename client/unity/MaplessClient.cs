// Where a photograph was taken, for Unity: one call, axes and stale answers taken care of. See the README beside this.
//
// Needs Google.Protobuf, Grpc.Net.Client and YetAnotherHttpHandler, and the messages that protoc makes of mapless's protos.

using System;
using System.Net.Http;
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
        // What a generated stub would hold; by hand it takes no gRPC plugin for protoc.
        private static readonly Method<LocalizeRequest, LocalizeResponse> LocalizeMethod =
            new Method<LocalizeRequest, LocalizeResponse>(
                MethodType.Unary,
                "mapless.v1.LocalizationService",
                "Localize",
                Marshallers.Create(message => message.ToByteArray(), LocalizeRequest.Parser.ParseFrom),
                Marshallers.Create(message => message.ToByteArray(), LocalizeResponse.Parser.ParseFrom));

        private const int MaxMessageBytes = 32 * 1024 * 1024;

        private readonly GrpcChannel channel;
        private readonly CallInvoker invoker;
        private readonly Metadata headers = new Metadata();

        /// <summary>Does not connect yet.</summary>
        /// <param name="address">"https://host:50051", or "http://..." for a server without TLS.</param>
        /// <param name="token">Sent to the server, if it requires one. Only over https.</param>
        /// <param name="clientId">Which device this is; the server is fair between them.</param>
        /// <param name="handler">Handler of HTTP/2; YetAnotherHttpHandler if null.</param>
        public MaplessClient(string address, string token = null, string clientId = null, HttpMessageHandler handler = null)
        {
            channel = GrpcChannel.ForAddress(address, new GrpcChannelOptions
            {
                HttpHandler = handler ?? new YetAnotherHttpHandler { Http2Only = true },
                DisposeHttpClient = true,
                MaxReceiveMessageSize = MaxMessageBytes,
                MaxSendMessageSize = MaxMessageBytes,
            });
            invoker = channel.CreateCallInvoker();
            if (token != null)
            {
                headers.Add("authorization", "Bearer " + token);
            }
            if (clientId != null)
            {
                headers.Add("x-client-id", clientId);
            }
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
        /// <param name="timeout">Deadline of the call; without it a lost server would block for ever.</param>
        /// <param name="cancellation">Ends the call earlier, on the server, too.</param>
        /// <exception cref="RpcException">
        /// Unavailable and ResourceExhausted: try again later, with a newer photograph. Others say what is wrong.
        /// </exception>
        public async Task<MaplessAnswer> LocalizeAsync(
            string scene,
            byte[] jpeg,
            CameraIntrinsics intrinsics,
            Pose sensorPose,
            DateTime captureTime,
            TimeSpan timeout,
            CancellationToken cancellation = default)
        {
            var request = new LocalizeRequest
            {
                Scene = scene,
                Image = ByteString.CopyFrom(jpeg),
                Intrinsics = intrinsics,
                CaptureTime = Timestamp.FromDateTime(captureTime.ToUniversalTime()),
                SessionFromCamera = ToMessage(sensorPose),
                Options = new LocalizeOptions { Axes = Axes.Unity },
            };
            // By the scene, a load balancer finds the server that has it in memory.
            var ofCall = new Metadata { { "x-mapless-scene", scene } };
            foreach (Metadata.Entry header in headers)
            {
                ofCall.Add(header);
            }
            var options = new CallOptions(ofCall, DateTime.UtcNow + timeout, cancellation);
            using (var call = invoker.AsyncUnaryCall(LocalizeMethod, null, options, request))
            {
                return new MaplessAnswer(await call.ResponseAsync.ConfigureAwait(true));
            }
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
            channel.Dispose();
        }
    }
}
