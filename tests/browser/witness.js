// Records violations of the content security policy. `quiet` waits until no short timer is pending:
// the page sends requests some time after the last change.
window.violations = [];
addEventListener('securitypolicyviolation', (event) =>
  window.violations.push(`${event.violatedDirective} ${event.blockedURI}`));
const pending = new Set();
const { setTimeout: start, clearTimeout: stop } = window;
window.setTimeout = (run, after = 0, ...rest) => {
  const timer = start(() => { pending.delete(timer); run(...rest); }, after);
  if (after < 200) pending.add(timer);
  return timer;
};
window.clearTimeout = (timer) => { pending.delete(timer); stop(timer); };
window.quiet = () => new Promise((done) => {
  const look = () => (pending.size ? start(look, 10) : done());
  look();
});
