// C++17 client 2.0.0 of the scene-reasoning service: one header, based on cpp-httplib and
// nlohmann/json.
//
//     scene::Client service({"http://127.0.0.1:8000"});
//     auto answer = service.missing({{"objects", {"bed", "nightstand"}}, {"top_k", 5}});
//
// Requests and answers are JSON as in the HTTP contract (docs/clients.md, /openapi.json). Every
// call ends within its timeout, except that the system's DNS lookup may take longer.
#pragma once

#ifndef _WIN32
#include <signal.h>
#endif

#include <httplib.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace scene {

using json = nlohmann::json;
using Clock = std::chrono::steady_clock;
using Seconds = std::chrono::duration<double>;

// ------------------------------------------------------------------------------------ errors

// Base class of all errors of a call.
struct Error : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// The client cannot send the request: invalid UTF-8, URL or API key, or a timeout out of range.
struct InvalidRequestError : Error {
  using Error::Error;
};

// The connection failed, or it broke before a complete answer arrived.
struct UnreachableError : Error {
  using Error::Error;
};

// The timeout of the call passed before the answer arrived.
struct DeadlineError : Error {
  using Error::Error;
};

// The status is 200, but the answer is too long or is not a JSON object.
struct AnswerError : Error {
  using Error::Error;
};

// One error in a request.
struct FieldError {
  std::string pointer;  // JSON pointer into the request, as a URI fragment
  std::string message;
  std::vector<std::string> suggestions;  // nearest known names, best first
};

// The service answered with a problem (RFC 9457). `what()` contains the title, the detail and the
// first errors with their pointers.
struct ProblemError : Error {
  std::string type = "about:blank";  // identifies the problem: /problems/unknown-labels
  int status = 0;
  std::string title;
  std::string detail;
  std::vector<FieldError> errors;
  std::string request_id;              // id of the request in the service's log
  std::optional<Seconds> retry_after;  // time to wait before the next attempt

  explicit ProblemError(const std::string& what) : Error(what) {}
};

// ------------------------------------------------------------------------------------ client

struct Options {
  std::string url = "http://127.0.0.1:8000";
  Seconds timeout{10.0};  // for a whole call, including retries and pauses
  std::string api_key{};  // needed if the service requires a key
  int retries = 5;        // maximum, after 429, 503 and broken connections, within the timeout
};

// Client with one connection to one service. Calls share the connection, so every thread needs a
// client of its own.
class Client {
 public:
  explicit Client(Options options = {})
      : options_(std::move(options)), address_(split(options_.url)), http_(address_.server) {
    if (!http_.is_valid()) throw InvalidRequestError("the URL is invalid");
    for (const char letter : options_.api_key)
      if (letter < '!' || letter > '~')
        throw InvalidRequestError("the API key must be ASCII, without spaces or line breaks");
    http_.set_keep_alive(true);
    http_.set_tcp_nodelay(true);
    http_.set_decompress(false);  // a decompressed body could have any size
  }

  // The six questions. `timeout` limits one call; the default is `Options::timeout`.
  json relations(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/relations", request, timeout);
  }
  json missing(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/missing", request, timeout);
  }
  json outliers(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/outliers", request, timeout);
  }
  json rooms(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/rooms", request, timeout);
  }
  json generate(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/generate", request, timeout);
  }
  json where(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/where", request, timeout);
  }

  // One question about many scenes or homes. `scenes` is an array of requests; each request has its
  // own entry in `results` of the answer.
  json relations_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/relations/batch", {{"scenes", scenes}}, timeout);
  }
  json missing_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/missing/batch", {{"scenes", scenes}}, timeout);
  }
  json outliers_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/outliers/batch", {{"scenes", scenes}}, timeout);
  }
  json rooms_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/rooms/batch", {{"scenes", scenes}}, timeout);
  }
  json where_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/where/batch", {{"scenes", scenes}}, timeout);
  }

  // List models, versions and aliases.
  json models(std::optional<Seconds> timeout = {}) {
    return call("GET", "/models", nullptr, timeout);
  }

  // Whether the service's default model can answer. This call has no retries.
  bool is_ready(std::optional<Seconds> timeout = {}) {
    try {
      exchange("GET", "/health/ready", "", timeout.value_or(options_.timeout), 0);
    } catch (const UnreachableError&) {
      return false;
    } catch (const DeadlineError&) {
      return false;
    } catch (const ProblemError& problem) {
      if (problem.status != 503) throw;
      return false;
    }
    return true;
  }

 private:
  struct Address {
    std::string server;  // scheme, host and port
    std::string prefix;  // path of the service behind a proxy
  };

  // Result of one attempt.
  struct Outcome {
    enum { Received, Lost, Late } kind;
    int status = 0;
    httplib::Headers headers{};
    std::string body{};
    std::string reason{};  // the reason phrase of the response, or the error of the connection
  };

#ifndef _WIN32
  // Blocks SIGPIPE in the current thread. A write to a closed connection raises this signal, which
  // ends programs that do not handle it. TLS writes even while it closes a broken connection.
  class NoBrokenPipe {
   public:
    NoBrokenPipe() {
      sigemptyset(&pipe_);
      sigaddset(&pipe_, SIGPIPE);
      sigset_t pending;
      sigpending(&pending);
      was_pending_ = sigismember(&pending, SIGPIPE) == 1;
      pthread_sigmask(SIG_BLOCK, &pipe_, &before_);
    }
    ~NoBrokenPipe() {
      sigset_t pending;
      sigpending(&pending);
      int signal = 0;
      if (!was_pending_ && sigismember(&pending, SIGPIPE) == 1) sigwait(&pipe_, &signal);
      pthread_sigmask(SIG_SETMASK, &before_, nullptr);
    }
    NoBrokenPipe(const NoBrokenPipe&) = delete;
    NoBrokenPipe& operator=(const NoBrokenPipe&) = delete;

   private:
    sigset_t pipe_;
    sigset_t before_;
    bool was_pending_ = false;
  };
#endif

  // Stops the HTTP client at the deadline. httplib limits only each wait on the socket, so a server
  // that sends single bytes slowly could hold a call for ever.
  class Watchdog {
   public:
    Watchdog(httplib::Client& http, Clock::time_point ends)
        : thread_([this, &http, ends] {
            std::unique_lock<std::mutex> lock(mutex_);
            if (!changed_.wait_until(lock, ends, [this] { return done_; })) http.stop();
          }) {}
    ~Watchdog() {
      {
        std::lock_guard<std::mutex> lock(mutex_);
        done_ = true;
      }
      changed_.notify_one();
      thread_.join();
    }
    Watchdog(const Watchdog&) = delete;
    Watchdog& operator=(const Watchdog&) = delete;

   private:
    std::mutex mutex_;
    std::condition_variable changed_;
    bool done_ = false;
    std::thread thread_;  // declared last: it uses the other members
  };

  static constexpr double kMaxTimeout = 600.0;  // seconds; the service's own limit
  static constexpr double kFirstPause = 0.05;
  static constexpr double kLongestPause = 2.0;
  static constexpr std::size_t kMaxAnswer = std::size_t{256} << 20;  // bytes
  static constexpr std::size_t kMostShown = 10;  // errors in the text of a ProblemError

  static Address split(const std::string& url) {
    const auto scheme = url.find("://");
    if (scheme == std::string::npos) throw InvalidRequestError("the URL must begin with http://");
    const auto path = url.find('/', scheme + 3);
    if (path == std::string::npos) return {url, ""};
    auto prefix = url.substr(path);
    while (!prefix.empty() && prefix.back() == '/') prefix.pop_back();
    return {url.substr(0, path), prefix};
  }

  json call(const char* method, const std::string& path, const json& request,
            std::optional<Seconds> timeout) {
    std::string body;
    try {
      if (!request.is_null()) body = request.dump();
    } catch (const json::exception& error) {
      throw InvalidRequestError(error.what());
    }
    const auto limit = timeout.value_or(options_.timeout);
    const auto received = exchange(method, path, body, limit, options_.retries);
    auto answer = json::parse(received.body, nullptr, /*allow_exceptions=*/false);
    if (!answer.is_object())
      throw AnswerError("the answer of " + path + " is not a JSON object; check the service's URL");
    return answer;
  }

  // Sends a request, with retries and pauses, until it has an answer or the deadline has passed.
  Outcome exchange(const char* method, const std::string& path, const std::string& body,
                   Seconds timeout, int retries) {
    if (!(timeout.count() >= 1e-3 && timeout.count() <= kMaxTimeout))
      throw InvalidRequestError("the timeout must be from 0.001 to 600 seconds");
    const auto ends = Clock::now() + std::chrono::duration_cast<Clock::duration>(timeout);
    const auto late = [&] {
      std::ostringstream what;
      what << address_.server << path << " did not answer within " << timeout.count() << " s";
      return what.str();
    };
    for (int attempt = 0;; ++attempt) {
      const Seconds left = ends - Clock::now();
      if (left.count() <= 0) throw DeadlineError(late());
      auto outcome = send(method, path, body, ends, left);
      // A valid answer after the deadline is an error, too: the caller relies on the deadline.
      const bool fine = outcome.kind == Outcome::Received && outcome.status == 200;
      if (outcome.kind == Outcome::Late || (fine && Clock::now() >= ends))
        throw DeadlineError(late());
      if (fine) return outcome;

      Seconds pause = pause_after(attempt);
      std::optional<ProblemError> problem;
      if (outcome.kind == Outcome::Received) {
        problem = problem_of(outcome);
        if (problem->status == 504) throw DeadlineError(late() + ": " + problem->detail);
        if (problem->status != 429 && problem->status != 503) throw *problem;
        // The random pause comes on top of Retry-After, so that clients do not retry all at once.
        if (problem->retry_after) pause += *problem->retry_after;
      }
      if (attempt >= retries || pause >= ends - Clock::now()) {
        if (problem) throw *problem;
        throw UnreachableError("cannot reach " + address_.server + ": " + outcome.reason);
      }
      std::this_thread::sleep_for(pause);
    }
  }

  Outcome send(const char* method, const std::string& path, const std::string& body,
               Clock::time_point ends, Seconds left) {
    Outcome outcome{Outcome::Received};
    httplib::Request request;
    request.method = method;
    request.path = address_.prefix + path;
    request.body = body;
    request.set_header("Accept", "application/json");
    request.set_header("Accept-Encoding", "identity");
    if (!body.empty()) request.set_header("Content-Type", "application/json");
    if (!options_.api_key.empty()) request.set_header("X-API-Key", options_.api_key);
    const auto told = std::max(1, static_cast<int>(left.count() * 1e3));
    request.set_header("X-Request-Timeout-Ms", std::to_string(told));
    request.content_receiver = [&outcome](const char* data, std::size_t length, std::uint64_t,
                                          std::uint64_t) {
      outcome.body.append(data, length);
      return outcome.body.size() <= kMaxAnswer;
    };
    const auto wait = std::chrono::ceil<std::chrono::microseconds>(left);
    http_.set_connection_timeout(wait);
    http_.set_read_timeout(wait);
    http_.set_write_timeout(wait);
    httplib::Result result = [&] {
#ifndef _WIN32
      NoBrokenPipe quiet;
#endif
      Watchdog watchdog(http_, ends);
      return http_.send(request);
    }();
    if (outcome.body.size() > kMaxAnswer) throw AnswerError("the answer is too long");
    if (!result) {
      // Less than 1 ms before the deadline counts as late: it is too short for a retry.
      const bool late = Clock::now() + std::chrono::milliseconds(1) >= ends;
      outcome.kind = late ? Outcome::Late : Outcome::Lost;
      outcome.reason = worded(result.error());
      return outcome;
    }
    outcome.status = result->status;
    outcome.reason = result->reason;
    outcome.headers = result->headers;
    return outcome;
  }

  static std::string worded(httplib::Error error) {
    switch (error) {
      case httplib::Error::Connection: return "connection refused, or unknown host";
      case httplib::Error::Read: return "the connection broke before the answer was complete";
      case httplib::Error::Write: return "the connection broke before the request was complete";
      default: return httplib::to_string(error);
    }
  }

  // Random pause; its maximum doubles with each attempt, up to kLongestPause seconds.
  Seconds pause_after(int attempt) {
    const double longest = std::min(kLongestPause, kFirstPause * std::pow(2.0, attempt));
    return Seconds(std::uniform_real_distribution<double>(0.0, longest)(random_));
  }

  static std::optional<Seconds> retry_after(const httplib::Headers& headers) {
    const auto found = headers.find("Retry-After");
    if (found == headers.end()) return std::nullopt;
    const auto& text = found->second;
    // The service sends seconds. A proxy may send a date, which is ignored.
    if (text.empty() || text.size() > 6 || text.find_first_not_of("0123456789") != text.npos)
      return std::nullopt;
    return Seconds(std::stod(text));
  }

  static std::string text(const json& document, const char* name) {
    const auto found = document.find(name);
    return found != document.end() && found->is_string() ? found->get<std::string>() : "";
  }

  static std::string shown(const FieldError& error) {
    std::string line = "\n  " + error.pointer + ": " + error.message;
    for (std::size_t k = 0; k < error.suggestions.size(); ++k)
      line += (k == 0 ? " (did you mean " : ", ") + error.suggestions[k];
    return error.suggestions.empty() ? line : line + "?)";
  }

  static ProblemError problem_of(const Outcome& outcome) {
    // A proxy or another server may send a body that is not a problem document.
    auto document = json::parse(outcome.body, nullptr, /*allow_exceptions=*/false);
    if (!document.is_object() || text(document, "type").empty())
      document = {{"type", "about:blank"},
                  {"title", outcome.reason},
                  {"detail", "The answer comes from another server, for example from a proxy."}};
    std::vector<FieldError> errors;
    std::string what = std::to_string(outcome.status) + " " + text(document, "title") + " (" +
                       text(document, "type") + "): " + text(document, "detail");
    if (const auto found = document.find("errors"); found != document.end() && found->is_array()) {
      for (const auto& entry : *found) {
        if (!entry.is_object()) continue;
        FieldError error{text(entry, "pointer"), text(entry, "message"), {}};
        if (const auto names = entry.find("suggestions"); names != entry.end() && names->is_array())
          for (const auto& name : *names)
            if (name.is_string()) error.suggestions.push_back(name.get<std::string>());
        if (errors.size() < kMostShown) what += shown(error);
        errors.push_back(std::move(error));
      }
    }
    if (errors.size() > kMostShown)
      what += "\n  and " + std::to_string(errors.size() - kMostShown) + " more errors";
    ProblemError problem(what);
    problem.type = text(document, "type");
    problem.status = outcome.status;
    problem.title = text(document, "title");
    problem.detail = text(document, "detail");
    problem.errors = std::move(errors);
    problem.request_id = text(document, "request_id");
    problem.retry_after = retry_after(outcome.headers);
    return problem;
  }

  Options options_;
  Address address_;
  httplib::Client http_;
  std::mt19937 random_{std::random_device{}()};
};

}  // namespace scene
