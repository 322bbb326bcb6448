// Puts calls, one a line of JSON on standard input, to scene_client.hpp, and says what became of
// each in a line of its own.
#include <iostream>
#include <string>

#include "scene_client.hpp"

using scene::json;

static json told(const scene::ProblemError& problem) {
  json errors = json::array();
  for (const auto& error : problem.errors)
    errors.push_back({{"pointer", error.pointer},
                      {"message", error.message},
                      {"suggestions", error.suggestions}});
  json told = {{"outcome", "problem"},      {"type", problem.type},
               {"status", problem.status},  {"title", problem.title},
               {"detail", problem.detail},  {"errors", errors},
               {"request_id", problem.request_id},
               {"text", problem.what()}};
  told["retry_after"] = problem.retry_after ? json(problem.retry_after->count()) : json();
  return told;
}

int main(int, char** argv) {
  scene::Options options;
  options.url = argv[1];
  options.timeout = scene::Seconds(std::stod(argv[2]));
  options.retries = std::stoi(argv[3]);
  options.api_key = argv[4];
  scene::Client service(options);
  std::string line;
  while (std::getline(std::cin, line)) {
    const auto call = json::parse(line);
    const auto method = call["method"].get<std::string>();
    const auto& request = call["request"];
    std::optional<scene::Seconds> timeout;
    if (call["timeout"].is_number()) timeout = scene::Seconds(call["timeout"].get<double>());
    json said;
    try {
      json answer;
      if (method == "relations") answer = service.relations(request, timeout);
      if (method == "missing") answer = service.missing(request, timeout);
      if (method == "outliers") answer = service.outliers(request, timeout);
      if (method == "rooms") answer = service.rooms(request, timeout);
      if (method == "generate") answer = service.generate(request, timeout);
      if (method == "where") answer = service.where(request, timeout);
      if (method == "relations_batch") answer = service.relations_batch(request, timeout);
      if (method == "missing_batch") answer = service.missing_batch(request, timeout);
      if (method == "outliers_batch") answer = service.outliers_batch(request, timeout);
      if (method == "rooms_batch") answer = service.rooms_batch(request, timeout);
      if (method == "where_batch") answer = service.where_batch(request, timeout);
      if (method == "models") answer = service.models(timeout);
      if (method == "is_ready") answer = service.is_ready(timeout);
      said = {{"outcome", "answer"}, {"answer", answer}};
    } catch (const scene::ProblemError& problem) {
      said = told(problem);
    } catch (const scene::DeadlineError& error) {
      said = {{"outcome", "deadline"}, {"message", error.what()}};
    } catch (const scene::UnreachableError& error) {
      said = {{"outcome", "unreachable"}, {"message", error.what()}};
    } catch (const scene::AnswerError& error) {
      said = {{"outcome", "unreadable"}, {"message", error.what()}};
    } catch (const scene::InvalidRequestError& error) {
      said = {{"outcome", "invalid"}, {"message", error.what()}};
    }
    std::cout << said.dump() << std::endl;
  }
}
