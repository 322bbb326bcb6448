// A client of the scene-reasoning service for C++17: one header over cpp-httplib and nlohmann/json.
//
//     scene::Client service({"http://127.0.0.1:8000"});
//     auto answer = service.missing({{"objects", {"bed", "nightstand"}}, {"top_k", 5}});
//
// Requests and answers are JSON as in the HTTP contract (docs/clients.md, /openapi.json). A call ends
// within its timeout whatever happens; only the system's resolution of names cannot be limited.
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

// A call that has no answer.
struct Error : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// The request cannot be sent: text that is no UTF-8, a timeout that makes no sense.
struct InvalidRequestError : Error {
  using Error::Error;
};

// No connection, or one that broke; nothing of an answer came.
struct UnreachableError : Error {
  using Error::Error;
};

// The call's time was over before its answer was there.
struct DeadlineError : Error {
  using Error::Error;
};

// The service succeeded, and its answer is none that this client can read.
struct AnswerError : Error {
  using Error::Error;
};

// One thing that is wrong with a request.
struct FieldError {
  std::string pointer;  // JSON pointer into the request, as a URI fragment
  std::string message;
  std::vector<std::string> suggestions;  // nearest known names, best first
};

// The service answered with a problem (RFC 9457).
struct ProblemError : Error {
  std::string type = "about:blank";  // branch on it: /problems/unknown-labels
  int status = 0;
  std::string title;
  std::string detail;
  std::vector<FieldError> errors;
  std::string request_id;             // to find it in the service's log
  std::optional<Seconds> retry_after;  // the service wants to be asked again then

  explicit ProblemError(const std::string& what) : Error(what) {}
};

// ------------------------------------------------------------------------------------ client

struct Options {
  std::string url = "http://127.0.0.1:8000";
  Seconds timeout{10.0};  // of a whole call, further attempts and pauses included
  std::string api_key{};  // where the service asks for one
  int retries = 5;        // after 429, 503 and broken connections, as far as there is time
};

// Asks one service over one connection, which calls share: threads that want to ask at the same
// time take a client each.
class Client {
 public:
  explicit Client(Options options = {})
      : options_(std::move(options)), address_(split(options_.url)), http_(address_.server) {
    if (!http_.is_valid()) throw InvalidRequestError("there is no service at such a URL");
    http_.set_keep_alive(true);
    http_.set_tcp_nodelay(true);
    http_.set_decompress(false);  // what is unpacked could be of any size
  }

  // The four questions. `timeout` is that of one call; by default the client's.
  json relations(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/relations", request, timeout);
  }
  json missing(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/missing", request, timeout);
  }
  json outliers(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/outliers", request, timeout);
  }
  json generate(const json& request, std::optional<Seconds> timeout = {}) {
    return call("POST", "/generate", request, timeout);
  }

  // The same for many scenes, an array of requests; each has an entry of its own in `results`.
  json relations_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/relations/batch", {{"scenes", scenes}}, timeout);
  }
  json missing_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/missing/batch", {{"scenes", scenes}}, timeout);
  }
  json outliers_batch(const json& scenes, std::optional<Seconds> timeout = {}) {
    return call("POST", "/outliers/batch", {{"scenes", scenes}}, timeout);
  }

  // Models, versions and aliases.
  json models(std::optional<Seconds> timeout = {}) {
    return call("GET", "/models", nullptr, timeout);
  }

  // Whether the service's default model answers; asked once.
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
    std::string prefix;  // path that a proxy strips
  };

  // What became of one attempt.
  struct Outcome {
    enum { Received, Lost, Late } kind;
    int status = 0;
    httplib::Headers headers{};
    std::string body{};
    std::string reason{};
  };

#ifndef _WIN32
  // Writing to a connection that has gone raises SIGPIPE, which ends programs that do not expect
  // it; TLS says goodbye even then. Kept from this thread, and from nobody else.
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

  // Ends what a client is doing when its time is over. httplib limits each wait on the socket;
  // a server that sends a byte now and then would keep it for ever.
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
    std::thread thread_;  // last: it uses the others
  };

  static constexpr double kMaxTimeout = 600.0;  // seconds; the service takes no more
  static constexpr double kFirstPause = 0.05;
  static constexpr double kLongestPause = 2.0;
  static constexpr std::size_t kMaxAnswer = std::size_t{256} << 20;  // bytes

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
      throw AnswerError("the answer of " + path + " is no JSON object: is this the service?");
    return answer;
  }

  // Everything from a call to its answer: attempts, and pauses between them, until the deadline.
  Outcome exchange(const char* method, const std::string& path, const std::string& body,
                   Seconds timeout, int retries) {
    if (!(timeout.count() >= 1e-3 && timeout.count() <= kMaxTimeout))
      throw InvalidRequestError("the timeout must be from 0.001 to 600 seconds");
    const auto ends = Clock::now() + std::chrono::duration_cast<Clock::duration>(timeout);
    for (int attempt = 0;; ++attempt) {
      const Seconds left = ends - Clock::now();
      if (left.count() <= 0) throw DeadlineError("no answer in time");
      auto outcome = send(method, path, body, ends, left);
      // An answer that is complete only now is none: whoever named a deadline has gone on without.
      const bool fine = outcome.kind == Outcome::Received && outcome.status == 200;
      if (outcome.kind == Outcome::Late || (fine && Clock::now() >= ends))
        throw DeadlineError("no answer in time");
      if (fine) return outcome;

      Seconds pause = pause_after(attempt);
      std::optional<ProblemError> problem;
      if (outcome.kind == Outcome::Received) {
        problem = problem_of(outcome);
        if (problem->status == 504) throw DeadlineError(problem->what());
        if (problem->status != 429 && problem->status != 503) throw *problem;
        // Never earlier than asked, and not all at once.
        if (problem->retry_after) pause += *problem->retry_after;
      }
      if (attempt >= retries || pause >= ends - Clock::now()) {
        if (problem) throw *problem;
        throw UnreachableError("no service: " + address_.server + ": " + outcome.reason);
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
      // A millisecond early is late all the same: nothing can be done with it.
      const bool late = Clock::now() + std::chrono::milliseconds(1) >= ends;
      outcome.kind = late ? Outcome::Late : Outcome::Lost;
      outcome.reason = httplib::to_string(result.error());
      return outcome;
    }
    outcome.status = result->status;
    outcome.headers = result->headers;
    return outcome;
  }

  // Doubling, capped, and each client's own.
  Seconds pause_after(int attempt) {
    const double longest = std::min(kLongestPause, kFirstPause * std::pow(2.0, attempt));
    return Seconds(std::uniform_real_distribution<double>(0.0, longest)(random_));
  }

  static std::optional<Seconds> retry_after(const httplib::Headers& headers) {
    const auto found = headers.find("Retry-After");
    if (found == headers.end()) return std::nullopt;
    const auto& text = found->second;
    // The service says seconds; of a date, which a proxy may say, nothing is made.
    if (text.empty() || text.size() > 6 || text.find_first_not_of("0123456789") != text.npos)
      return std::nullopt;
    return Seconds(std::stod(text));
  }

  static std::string text(const json& document, const char* name) {
    const auto found = document.find(name);
    return found != document.end() && found->is_string() ? found->get<std::string>() : "";
  }

  static ProblemError problem_of(const Outcome& outcome) {
    // Of a proxy, or of something else altogether, it is no problem document.
    auto document = json::parse(outcome.body, nullptr, /*allow_exceptions=*/false);
    if (!document.is_object()) document = json::object();
    std::vector<FieldError> errors;
    std::string what = std::to_string(outcome.status) + " " + text(document, "type") + ": " +
                       text(document, "detail");
    if (const auto found = document.find("errors"); found != document.end() && found->is_array()) {
      for (const auto& entry : *found) {
        if (!entry.is_object()) continue;
        FieldError error{text(entry, "pointer"), text(entry, "message"), {}};
        if (const auto names = entry.find("suggestions"); names != entry.end() && names->is_array())
          for (const auto& name : *names)
            if (name.is_string()) error.suggestions.push_back(name.get<std::string>());
        what += "\n  " + error.pointer + ": " + error.message;
        if (!error.suggestions.empty()) what += " (did you mean " + error.suggestions[0] + "?)";
        errors.push_back(std::move(error));
      }
    }
    ProblemError problem(what);
    if (const auto type = text(document, "type"); !type.empty()) problem.type = type;
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
