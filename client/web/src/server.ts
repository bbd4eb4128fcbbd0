// The connection to a server: the gateway that served this page, or the one that the page itself names. Not its address: a link
// would send the token that a person enters to whomever it names.
import { createClient, type Interceptor } from "@connectrpc/connect";
import { createGrpcWebTransport } from "@connectrpc/connect-web";
import { LocalizationService, type LocalizeResponse } from "./gen/mapless/v1/localization_service_pb.js";
import { ReferenceService } from "./gen/mapless/v1/reference_service_pb.js";

export const parameters = new URLSearchParams(location.search);

/** Sends the token that the page's field holds; it is kept nowhere. */
const withToken: Interceptor = (next) => (request) => {
  const token = document.querySelector<HTMLInputElement>("#token")?.value.trim();
  if (token) request.header.set("authorization", `Bearer ${token}`);
  return next(request);
};

const transport = createGrpcWebTransport({
  baseUrl: document.querySelector<HTMLMetaElement>('meta[name="mapless-server"]')?.content || location.origin,
  interceptors: [withToken],
  defaultTimeoutMs: 30_000,
});

export const localization = createClient(LocalizationService, transport);
export const references = createClient(ReferenceService, transport);

/** What an answer says, in a sentence. */
export function described(answer: LocalizeResponse | undefined, isFinal: boolean): string {
  if (answer?.outcome.case === "rejection") {
    const { message, hint } = answer.outcome.value;
    return `Not localized: ${message}. ${hint?.message ?? ""}`;
  }
  if (answer?.outcome.case !== "localization") return "No answer.";
  const { accuracy, trust, inlierCount } = answer.outcome.value;
  if (!accuracy) return isFinal ? "Coarse pose." : "Coarse pose; a better one follows.";
  const radius = accuracy.position95M < 1 ? `${(100 * accuracy.position95M).toFixed(1)} cm` : `${accuracy.position95M.toFixed(2)} m`;
  const found = `within ${radius} in 95 % of cases, ${inlierCount} matches, trust ${(trust ?? 0).toFixed(2)}`;
  return isFinal ? `Localized: ${found}.` : `So far: ${found}; a better pose may follow.`;
}

/** The element with an id, which the page has. */
export function element<T extends HTMLElement>(id: string): T {
  return document.getElementById(id) as T;
}
